"""Offline data: behaviour policies, local collection, guards and replay buffers.

Collecting needs Gymnasium, MuJoCo, tqdm and platformdirs (``torchrl-osr[examples]``);
the names that do are loaded on first use, so that everything else works without them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchrl_osr.data.behavior import (
    BehaviorPolicy,
    load_behavior_card,
    load_behavior_policy,
    save_behavior_policy,
    update_behavior_card,
)
from torchrl_osr.data.reference_scores import (
    REFERENCE_RETURNS,
    ReferenceReturns,
    normalized_score,
)
from torchrl_osr.data.replay_buffer import (
    make_replay_buffer,
    observation_statistics,
    split_held_out,
)
from torchrl_osr.data.validation import check_dataset

if TYPE_CHECKING:
    from torchrl_osr.data.collection import (
        Collection,
        collect_transitions,
        measure_policy,
    )
    from torchrl_osr.data.environment import make_environment
    from torchrl_osr.data.levels import LEVELS, collect_level
    from torchrl_osr.data.local import load_local_dataset
    from torchrl_osr.data.mixtures import load_mixture, mix_datasets

_NEEDS_EXAMPLES_EXTRA = {
    "LEVELS": "levels",
    "Collection": "collection",
    "collect_level": "levels",
    "collect_transitions": "collection",
    "make_environment": "environment",
    "measure_policy": "collection",
    "load_local_dataset": "local",
    "load_mixture": "mixtures",
    "mix_datasets": "mixtures",
}

__all__ = [
    "LEVELS",
    "REFERENCE_RETURNS",
    "BehaviorPolicy",
    "Collection",
    "ReferenceReturns",
    "check_dataset",
    "collect_level",
    "collect_transitions",
    "load_behavior_card",
    "load_behavior_policy",
    "load_local_dataset",
    "load_mixture",
    "make_environment",
    "make_replay_buffer",
    "measure_policy",
    "mix_datasets",
    "normalized_score",
    "observation_statistics",
    "save_behavior_policy",
    "split_held_out",
    "update_behavior_card",
]


def __getattr__(name: str) -> Any:
    if name in _NEEDS_EXAMPLES_EXTRA:
        return getattr(import_module(f"{__name__}.{_NEEDS_EXAMPLES_EXTRA[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
