"""Loss modules, one a file; the mathematics is in :mod:`torchrl_osr.functional`."""

from torchrl_osr.objectives.inverse_dynamics import InverseDynamicsLoss
from torchrl_osr.objectives.osr import OSRLoss

__all__ = ["InverseDynamicsLoss", "OSRLoss"]
