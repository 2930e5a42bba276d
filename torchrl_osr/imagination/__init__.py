"""Transitions that a dynamics model imagines: roll-outs, their ends, their batches.

* :func:`imagine` rolls a policy out in a
  :class:`~torchrl_osr.modules.DynamicsEnsemble`.
* :func:`disturbed` gives the states that random actions lead to.
* :func:`expect` says what each network of one expects of a policy.
* :func:`imagine_backwards` rolls one out into given states, in a model of turned
  rows (:func:`turned`).
* :class:`ModelAdversary` trains a model against the policy.
* :func:`termination` has the rule by which a task ends.
* :class:`SwitchingPolicy` rolls several policies out in models and lets the best act.
* :class:`LookAheadPolicy` plans in one, where it is far from its data.
* :class:`ImaginedReplayBuffer` mixes real rows with imagined ones.
"""

from torchrl_osr.imagination.adversary import ModelAdversary
from torchrl_osr.imagination.look_ahead import LookAheadPolicy
from torchrl_osr.imagination.replay_buffer import ImaginedReplayBuffer
from torchrl_osr.imagination.rollout import (
    Expected,
    Imagined,
    any_action,
    disturbed,
    expect,
    imagine,
    imagine_backwards,
    turned,
)
from torchrl_osr.imagination.switching import SwitchingPolicy
from torchrl_osr.imagination.termination import Termination, never, termination

__all__ = [
    "Expected",
    "Imagined",
    "ImaginedReplayBuffer",
    "LookAheadPolicy",
    "ModelAdversary",
    "SwitchingPolicy",
    "Termination",
    "any_action",
    "disturbed",
    "expect",
    "imagine",
    "imagine_backwards",
    "never",
    "termination",
    "turned",
]
