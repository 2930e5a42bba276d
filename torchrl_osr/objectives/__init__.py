"""Loss modules, one a file; the mathematics is in :mod:`torchrl_osr.functional`."""

from torchrl_osr.objectives.actor_critic import ActorCriticLoss
from torchrl_osr.objectives.cql import CQLLoss
from torchrl_osr.objectives.discrete_osr import DiscreteOSRLoss
from torchrl_osr.objectives.inverse_dynamics import InverseDynamicsLoss
from torchrl_osr.objectives.osr import OSRLoss
from torchrl_osr.objectives.osr_v import OSRVLoss
from torchrl_osr.objectives.state_recovery import StateRecoveryLoss, WithRecovery

__all__ = [
    "ActorCriticLoss",
    "CQLLoss",
    "DiscreteOSRLoss",
    "InverseDynamicsLoss",
    "OSRLoss",
    "OSRVLoss",
    "StateRecoveryLoss",
    "WithRecovery",
]
