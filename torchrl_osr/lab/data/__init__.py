"""Offline data: rolled out on this machine or recorded, in memory or memory-mapped.

:func:`load_dataset` loads any of them. Names that need Gymnasium are loaded on first
use: reading a trained policy does not need it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchrl_osr.lab.data.behavior import load_behavior_policy
from torchrl_osr.lab.data.recording import transitions_from_columns
from torchrl_osr.lab.data.statistics import (
    ReferenceReturns,
    observation_statistics,
    reference_returns,
)
from torchrl_osr.lab.data.store import load_memmap, make_replay_buffer, write_memmap
from torchrl_osr.lab.data.transitions import check_dataset

if TYPE_CHECKING:
    from torchrl_osr.lab.data.environment import (
        EnvironmentSpec,
        environment_spec,
        make_environment,
    )
    from torchrl_osr.lab.data.rollout import collect_transitions
    from torchrl_osr.lab.data.sources import load_dataset

_ON_FIRST_USE = {
    "EnvironmentSpec": "environment",
    "collect_transitions": "rollout",
    "environment_spec": "environment",
    "load_dataset": "sources",
    "make_environment": "environment",
}

__all__ = [
    "EnvironmentSpec",
    "ReferenceReturns",
    "check_dataset",
    "collect_transitions",
    "environment_spec",
    "load_behavior_policy",
    "load_dataset",
    "load_memmap",
    "make_environment",
    "make_replay_buffer",
    "observation_statistics",
    "reference_returns",
    "transitions_from_columns",
    "write_memmap",
]


def __getattr__(name: str) -> Any:
    if name in _ON_FIRST_USE:
        return getattr(import_module(f"{__name__}.{_ON_FIRST_USE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
