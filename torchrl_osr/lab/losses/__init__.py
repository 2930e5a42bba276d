"""The losses that OSR is compared with. They need the extra ``train``."""

from torchrl_osr.lab.losses.cloning import BCLoss, IQLLoss
from torchrl_osr.lab.losses.ensembles import EDACLoss, RORLLoss
from torchrl_osr.lab.losses.evaluation import FQELoss
from torchrl_osr.lab.losses.state_deviation import StateDeviationLoss
from torchrl_osr.lab.losses.td3 import ReBRACLoss, TD3BCLoss

__all__ = [
    "BCLoss",
    "EDACLoss",
    "FQELoss",
    "IQLLoss",
    "RORLLoss",
    "ReBRACLoss",
    "StateDeviationLoss",
    "TD3BCLoss",
]
