"""Loss modules, one a file; the mathematics is in :mod:`torchrl_osr.functional`."""

from torchrl_osr.objectives.inverse_dynamics import InverseDynamicsLoss
from torchrl_osr.objectives.osr import OSRLoss
from torchrl_osr.objectives.osr_v import OSRVLoss

__all__ = ["InverseDynamicsLoss", "OSRLoss", "OSRVLoss"]
