"""The losses that OSR is compared with."""

from torchrl_osr.lab.losses.adversary import Adversary
from torchrl_osr.lab.losses.bc import BCLoss
from torchrl_osr.lab.losses.edac import EDACLoss
from torchrl_osr.lab.losses.iql import IQLLoss
from torchrl_osr.lab.losses.rorl import RORLLoss
from torchrl_osr.lab.losses.scas import SCASLoss
from torchrl_osr.lab.losses.sdc import StateDeviationLoss
from torchrl_osr.lab.losses.td3 import ReBRACLoss, TD3BCLoss

__all__ = [
    "Adversary",
    "BCLoss",
    "EDACLoss",
    "IQLLoss",
    "RORLLoss",
    "ReBRACLoss",
    "SCASLoss",
    "StateDeviationLoss",
    "TD3BCLoss",
]
