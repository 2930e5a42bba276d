"""Disturbances for robustness evaluation, as Gymnasium wrappers.

* ``reset(seed=...)`` seeds the disturbance, too. Its random generator is its own:
  episodes with and without it start in the same state.
* Strength 0 is the bare environment, bit for bit.
* ``info["disturbed"]`` is true in each step in which a disturbance acted.

To combine several, wrap the task first in changes of dynamics and start state, then in
knocks and pushes, actuators, and sensors.
"""

from torchrl_osr.lab.envs.disturbance import NotPossible
from torchrl_osr.lab.envs.faults import (
    ActionDelay,
    DynamicsChange,
    ObservationNoise,
    StartStateNoise,
)
from torchrl_osr.lab.envs.timed import ActionKnock, ExternalPush

__all__ = [
    "ActionDelay",
    "ActionKnock",
    "DynamicsChange",
    "ExternalPush",
    "NotPossible",
    "ObservationNoise",
    "StartStateNoise",
]
