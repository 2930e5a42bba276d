"""Offline data: behaviour policies, collection, readers, guards and replay buffers.

Collecting needs Gymnasium, MuJoCo, tqdm and platformdirs (``torchrl-osr[examples]``),
reading HDF5, Arrow or Parquet those and Minari, h5py and pyarrow (``[minari]``); the
names that do are loaded on first use, so that everything else works without them.

Importing this registers ``osr-minari`` with ``torchrl.data.datasets.load_dataset``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchrl.data.datasets import register_dataset

from torchrl_osr.data.behavior import (
    BehaviorPolicy,
    load_behavior_card,
    load_behavior_policy,
    save_behavior_policy,
    update_behavior_card,
)
from torchrl_osr.data.on_disk import TransitionsOnDisk
from torchrl_osr.data.reference_scores import (
    REFERENCE_RETURNS,
    ReferenceReturns,
    normalized_score,
)
from torchrl_osr.data.replay_buffer import (
    make_replay_buffer,
    observation_statistics,
    split_held_out,
    split_on_disk,
)
from torchrl_osr.data.validation import check_dataset

if TYPE_CHECKING:
    from torchrl_osr.data.collection import (
        Collection,
        collect_transitions,
        measure_policy,
    )
    from torchrl_osr.data.d4rl_reader import load_d4rl
    from torchrl_osr.data.disk_writer import write_on_disk
    from torchrl_osr.data.environment import make_environment
    from torchrl_osr.data.episodes import transitions_from_episodes
    from torchrl_osr.data.file_reader import load_file
    from torchrl_osr.data.levels import LEVELS, collect_level
    from torchrl_osr.data.local import load_local_dataset
    from torchrl_osr.data.minari_export import export_minari
    from torchrl_osr.data.minari_reader import load_minari, minari_replay_buffer
    from torchrl_osr.data.mixtures import load_mixture, mix_datasets
    from torchrl_osr.data.sources import load_dataset
    from torchrl_osr.data.trajectories import transitions_from_rows

_NEEDS_EXTRA = {
    "LEVELS": "levels",
    "Collection": "collection",
    "collect_level": "levels",
    "collect_transitions": "collection",
    "export_minari": "minari_export",
    "load_d4rl": "d4rl_reader",
    "load_dataset": "sources",
    "load_file": "file_reader",
    "load_minari": "minari_reader",
    "make_environment": "environment",
    "measure_policy": "collection",
    "load_local_dataset": "local",
    "load_mixture": "mixtures",
    "minari_replay_buffer": "minari_reader",
    "mix_datasets": "mixtures",
    "transitions_from_episodes": "episodes",
    "transitions_from_rows": "trajectories",
    "write_on_disk": "disk_writer",
}

__all__ = [
    "LEVELS",
    "REFERENCE_RETURNS",
    "BehaviorPolicy",
    "Collection",
    "ReferenceReturns",
    "TransitionsOnDisk",
    "check_dataset",
    "collect_level",
    "collect_transitions",
    "export_minari",
    "load_behavior_card",
    "load_behavior_policy",
    "load_d4rl",
    "load_dataset",
    "load_file",
    "load_local_dataset",
    "load_minari",
    "load_mixture",
    "make_environment",
    "make_replay_buffer",
    "measure_policy",
    "minari_replay_buffer",
    "mix_datasets",
    "normalized_score",
    "observation_statistics",
    "save_behavior_policy",
    "split_held_out",
    "split_on_disk",
    "transitions_from_episodes",
    "transitions_from_rows",
    "update_behavior_card",
    "write_on_disk",
]

# By name, so that Minari is imported when such a set is asked for.
register_dataset(
    "osr-minari",
    "torchrl_osr.data.minari_reader:minari_replay_buffer",
    replace=True,
)


def __getattr__(name: str) -> Any:
    if name in _NEEDS_EXTRA:
        return getattr(import_module(f"{__name__}.{_NEEDS_EXTRA[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
