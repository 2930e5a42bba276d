"""Out-of-sample events of a robustness evaluation, as Gymnasium wrappers.

What knocks, pushes, blinds or changes the robot while a policy is evaluated. The
wrappers work in TorchRL (:class:`~torchrl.envs.GymWrapper`) and in plain Gymnasium
loops. They have in common:

* ``reset(seed=...)`` seeds the disturbance of an episode. It draws from a generator of
  its own, so the start state is that of the bare environment with the same seed, and
  episodes with and without can be compared in pairs;
* strength 0 is the bare environment, to the last bit;
* ``info["disturbed"]`` says in each step whether a disturbance acted, this one or one
  inside it. One that acts always is flagged in every step.

Order matters where several are combined. From the task outwards: changes of dynamics
and start state, knocks and pushes, actuators, sensors. The attacks on observations need
the networks: they make a policy of a policy (:func:`attacked_policy`).

Gymnasium and MuJoCo come with ``torchrl-osr[examples]``.
"""

from torchrl_osr.envs.actuators import ActionDelay, ActionNoise, StickyAction
from torchrl_osr.envs.base import Disturbance
from torchrl_osr.envs.dynamics import DynamicsChange
from torchrl_osr.envs.knock import ActionKnock
from torchrl_osr.envs.observation_attack import attacked_policy, networks_of
from torchrl_osr.envs.push import ExternalPush
from torchrl_osr.envs.sensors import ObservationNoise
from torchrl_osr.envs.start_state import StartStateNoise

__all__ = [
    "ActionDelay",
    "ActionKnock",
    "ActionNoise",
    "Disturbance",
    "DynamicsChange",
    "ExternalPush",
    "ObservationNoise",
    "StartStateNoise",
    "StickyAction",
    "attacked_policy",
    "networks_of",
]
