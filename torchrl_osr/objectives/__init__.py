"""Loss modules, one a file; the mathematics is in :mod:`torchrl_osr.functional`."""

from torchrl_osr.objectives.adversary import Adversary
from torchrl_osr.objectives.base import BaseLoss
from torchrl_osr.objectives.bc import BCLoss
from torchrl_osr.objectives.conditional_vae import ConditionalVAELoss
from torchrl_osr.objectives.discrete_osr import DiscreteOSRLoss
from torchrl_osr.objectives.dynamics import DynamicsLoss
from torchrl_osr.objectives.edac import EDACLoss
from torchrl_osr.objectives.inverse_dynamics import InverseDynamicsLoss
from torchrl_osr.objectives.iql import IQLLoss
from torchrl_osr.objectives.osr import OSRLoss
from torchrl_osr.objectives.osr_v import OSRVLoss
from torchrl_osr.objectives.rebrac import ReBRACLoss
from torchrl_osr.objectives.rorl import RORLLoss
from torchrl_osr.objectives.scas import SCASLoss
from torchrl_osr.objectives.sdc import SDCLoss
from torchrl_osr.objectives.state_recovery import StateRecoveryLoss
from torchrl_osr.objectives.td3_bc import TD3BCLoss

__all__ = [
    "Adversary",
    "BCLoss",
    "BaseLoss",
    "ConditionalVAELoss",
    "DiscreteOSRLoss",
    "DynamicsLoss",
    "EDACLoss",
    "IQLLoss",
    "InverseDynamicsLoss",
    "OSRLoss",
    "OSRVLoss",
    "RORLLoss",
    "ReBRACLoss",
    "SCASLoss",
    "SDCLoss",
    "StateRecoveryLoss",
    "TD3BCLoss",
]
