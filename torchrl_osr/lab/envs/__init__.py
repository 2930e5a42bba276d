"""Out-of-sample events of a robustness evaluation, as Gymnasium wrappers.

The wrappers work in TorchRL (:class:`~torchrl.envs.GymWrapper`) and in plain Gymnasium
loops. They have in common:

* ``reset(seed=...)`` seeds the disturbance of an episode. It draws from a generator of
  its own, so the start state is that of the bare environment with the same seed, and
  episodes with and without the disturbance can be compared in pairs;
* strength 0 is the bare environment, bit for bit;
* ``info["disturbed"]`` is true in each step in which a disturbance acted, this one or
  one inside it. Disturbances that always act set it in every step.

Order matters where several are combined. From the task outwards: changes of dynamics
and start state, knocks and pushes, actuators, sensors. Attacks on observations need the
networks: :func:`attacked_policy` makes an attacked policy from a policy.

Gymnasium and MuJoCo come with ``torchrl-osr[train]``.
"""

from torchrl_osr._extras import needed_by

with needed_by("disturbances need", "train"):
    import gymnasium  # noqa: F401
    import mujoco  # noqa: F401

from torchrl_osr.lab.envs.disturbance import NotPossible
from torchrl_osr.lab.envs.faults import (
    ActionDelay,
    ActionNoise,
    ObservationNoise,
    StickyAction,
)
from torchrl_osr.lab.envs.observation_attack import attacked_policy, critics_of
from torchrl_osr.lab.envs.simulation import DynamicsChange, StartStateNoise
from torchrl_osr.lab.envs.timed import ActionKnock, ExternalPush

__all__ = [
    "ActionDelay",
    "ActionKnock",
    "ActionNoise",
    "DynamicsChange",
    "ExternalPush",
    "NotPossible",
    "ObservationNoise",
    "StartStateNoise",
    "StickyAction",
    "attacked_policy",
    "critics_of",
]
