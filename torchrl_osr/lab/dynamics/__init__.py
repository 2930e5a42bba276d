"""Dynamics models: training, roll-outs, and policies and losses that use them."""

from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE, ConditionalVAELoss
from torchrl_osr.lab.dynamics.data import ModelData
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.options import DynamicsOptions
from torchrl_osr.lab.dynamics.rollout_buffer import RolloutReplayBuffer
from torchrl_osr.lab.dynamics.rollouts import rollout, termination
from torchrl_osr.lab.dynamics.switching import EliteNetworks, SwitchingPolicy

__all__ = [
    "ConditionalVAE",
    "ConditionalVAELoss",
    "DynamicsEnsemble",
    "DynamicsLoss",
    "DynamicsOptions",
    "EliteNetworks",
    "ModelAdversary",
    "ModelData",
    "RolloutReplayBuffer",
    "SwitchingPolicy",
    "rollout",
    "termination",
]
