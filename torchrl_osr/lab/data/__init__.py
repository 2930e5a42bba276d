"""Offline data: rolled out on this machine or recorded.

:func:`load_dataset` loads any of them.
"""

from torchrl_osr.lab.data.behavior import load_behavior_policy
from torchrl_osr.lab.data.columns import transitions_from_columns
from torchrl_osr.lab.data.environment import (
    EnvironmentSpec,
    environment_spec,
    make_environment,
)
from torchrl_osr.lab.data.rollout import collect_transitions
from torchrl_osr.lab.data.sources import load_dataset
from torchrl_osr.lab.data.statistics import (
    ReferenceReturns,
    observation_statistics,
    reference_returns,
)
from torchrl_osr.lab.data.store import make_replay_buffer
from torchrl_osr.lab.data.transitions import check_dataset

__all__ = [
    "EnvironmentSpec",
    "ReferenceReturns",
    "check_dataset",
    "collect_transitions",
    "environment_spec",
    "load_behavior_policy",
    "load_dataset",
    "make_environment",
    "make_replay_buffer",
    "observation_statistics",
    "reference_returns",
    "transitions_from_columns",
]
