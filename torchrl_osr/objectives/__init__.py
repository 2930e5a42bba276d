"""Loss modules, one a file; the mathematics is in :mod:`torchrl_osr.functional`."""

from torchrl_osr.objectives.base import BaseLoss
from torchrl_osr.objectives.discrete_osr import DiscreteOSRLoss
from torchrl_osr.objectives.inverse_dynamics import InverseDynamicsLoss
from torchrl_osr.objectives.osr import OSRLoss
from torchrl_osr.objectives.osr_v import OSRVLoss
from torchrl_osr.objectives.state_recovery import StateRecoveryLoss

__all__ = [
    "BaseLoss",
    "DiscreteOSRLoss",
    "InverseDynamicsLoss",
    "OSRLoss",
    "OSRVLoss",
    "StateRecoveryLoss",
]
