"""Dynamics models: training, roll-outs, and policies and losses that use them."""

from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.options import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.rollout_buffer import RolloutReplayBuffer
from torchrl_osr.lab.dynamics.rollouts import rollout, termination
from torchrl_osr.lab.dynamics.switching import EliteNetworks, SwitchingPolicy
from torchrl_osr.lab.dynamics.transition_vae import TransitionVAE, TransitionVAELoss

__all__ = [
    "DynamicsEnsemble",
    "DynamicsLoss",
    "DynamicsOptions",
    "EliteNetworks",
    "ModelAdversary",
    "ModelData",
    "RolloutReplayBuffer",
    "SwitchingPolicy",
    "TransitionVAE",
    "TransitionVAELoss",
    "rollout",
    "termination",
]
