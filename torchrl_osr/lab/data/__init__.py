"""Offline data: collected on this machine or recorded, in memory or memory-mapped.

Three rooms, each of which knows only those before it: ``store`` (what a data set is,
where its rows are, how they are drawn), ``collect`` (tasks, behaviour policies,
roll-outs) and ``read`` (Minari, D4RL, files of your own). ``load_dataset`` opens all.

Collecting needs Gymnasium, MuJoCo, tqdm and platformdirs (``torchrl-osr[train]``),
reading HDF5, Arrow or Parquet those and Minari, h5py and pyarrow (``[minari]``); the
names that do are loaded on first use, so that everything else works without them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchrl_osr.lab.data.collect.behavior import (
    BehaviorPolicy,
    load_behavior_card,
    load_behavior_policy,
    save_behavior_policy,
    update_behavior_card,
)
from torchrl_osr.lab.data.collect.reference_scores import (
    REFERENCE_RETURNS,
    ReferenceReturns,
    normalized_score,
    reference_returns,
)
from torchrl_osr.lab.data.store.next_action import check_order, next_action
from torchrl_osr.lab.data.store.replay_buffer import (
    check_memory,
    is_memory_mapped,
    make_replay_buffer,
)
from torchrl_osr.lab.data.store.splits import (
    consecutive_rows,
    held_out_rows,
    mix_datasets,
    split_held_out,
)
from torchrl_osr.lab.data.store.statistics import (
    observation_statistics,
    sampled_observations,
)
from torchrl_osr.lab.data.store.validation import ACTION_LIMIT, check_dataset

if TYPE_CHECKING:
    from torchrl_osr.lab.data.collect.environment import (
        MAZE_IDS,
        EnvironmentSpec,
        environment_spec,
        make_environment,
    )
    from torchrl_osr.lab.data.collect.local import load_local_dataset
    from torchrl_osr.lab.data.collect.mazes import MAZE_QUALITIES
    from torchrl_osr.lab.data.collect.qualities import (
        QUALITIES,
        collect_quality,
        quality_policies,
    )
    from torchrl_osr.lab.data.collect.rollout import (
        Collection,
        collect_transitions,
    )
    from torchrl_osr.lab.data.read.arrays import (
        transitions_from_episodes,
        transitions_from_rows,
    )
    from torchrl_osr.lab.data.read.d4rl import load_d4rl
    from torchrl_osr.lab.data.read.files import load_file
    from torchrl_osr.lab.data.read.minari import load_minari
    from torchrl_osr.lab.data.read.minari_export import export_minari
    from torchrl_osr.lab.data.sources import RECORDED, load_dataset
    from torchrl_osr.lab.data.store.memmap import load_memmap, write_memmap

_NEEDS_EXTRA = {
    "Collection": "collect.rollout",
    "EnvironmentSpec": "collect.environment",
    "MAZE_IDS": "collect.environment",
    "MAZE_QUALITIES": "collect.mazes",
    "QUALITIES": "collect.qualities",
    "RECORDED": "sources",
    "collect_quality": "collect.qualities",
    "collect_transitions": "collect.rollout",
    "environment_spec": "collect.environment",
    "export_minari": "read.minari_export",
    "load_d4rl": "read.d4rl",
    "load_dataset": "sources",
    "load_file": "read.files",
    "load_local_dataset": "collect.local",
    "load_memmap": "store.memmap",
    "load_minari": "read.minari",
    "make_environment": "collect.environment",
    "quality_policies": "collect.qualities",
    "transitions_from_episodes": "read.arrays",
    "transitions_from_rows": "read.arrays",
    "write_memmap": "store.memmap",
}

__all__ = [
    "ACTION_LIMIT",
    "MAZE_IDS",
    "MAZE_QUALITIES",
    "QUALITIES",
    "RECORDED",
    "REFERENCE_RETURNS",
    "BehaviorPolicy",
    "Collection",
    "EnvironmentSpec",
    "ReferenceReturns",
    "check_dataset",
    "check_memory",
    "check_order",
    "collect_quality",
    "collect_transitions",
    "consecutive_rows",
    "environment_spec",
    "export_minari",
    "held_out_rows",
    "is_memory_mapped",
    "load_behavior_card",
    "load_behavior_policy",
    "load_d4rl",
    "load_dataset",
    "load_file",
    "load_local_dataset",
    "load_memmap",
    "load_minari",
    "make_environment",
    "make_replay_buffer",
    "mix_datasets",
    "next_action",
    "normalized_score",
    "observation_statistics",
    "quality_policies",
    "reference_returns",
    "sampled_observations",
    "save_behavior_policy",
    "split_held_out",
    "transitions_from_episodes",
    "transitions_from_rows",
    "update_behavior_card",
    "write_memmap",
]


def __getattr__(name: str) -> Any:
    if name in _NEEDS_EXTRA:
        return getattr(import_module(f"{__name__}.{_NEEDS_EXTRA[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
