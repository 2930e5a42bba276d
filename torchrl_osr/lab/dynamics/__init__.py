"""Transitions that a dynamics model imagines: roll-outs, their ends, their batches.

* :func:`imagine` rolls a policy out in a
  :class:`~torchrl_osr.lab.dynamics.DynamicsEnsemble`.
* :func:`disturbed` gives the states that random actions lead to.
* :func:`expect` says what each network of one expects of a policy.
* :func:`imagine_backwards` rolls one out into given states, in a model of turned
  rows (:func:`turned`).
* :class:`ModelAdversary` trains a model against the policy.
* :func:`termination` has the rule by which a task ends.
* :class:`SwitchingPolicy` rolls several policies out in models and lets the best act.
* :class:`ImaginedReplayBuffer` mixes real rows with imagined ones.
"""

from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE
from torchrl_osr.lab.dynamics.conditional_vae_loss import ConditionalVAELoss
from torchrl_osr.lab.dynamics.dynamics_loss import DynamicsLoss
from torchrl_osr.lab.dynamics.elite_networks import EliteNetworks
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.options import DynamicsOptions
from torchrl_osr.lab.dynamics.rollout import (
    Expected,
    Imagined,
    any_action,
    disturbed,
    expect,
    imagine,
    imagine_backwards,
    turned,
)
from torchrl_osr.lab.dynamics.rollout_buffer import ImaginedReplayBuffer
from torchrl_osr.lab.dynamics.switching import SwitchingPolicy
from torchrl_osr.lab.dynamics.termination import Termination, never, termination

__all__ = [
    "ConditionalVAE",
    "ConditionalVAELoss",
    "DynamicsEnsemble",
    "DynamicsLoss",
    "DynamicsOptions",
    "EliteNetworks",
    "Expected",
    "Imagined",
    "ImaginedReplayBuffer",
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
