"""Dynamics models: training, rollouts, and policies and losses that use them."""

from torchrl_osr.lab.dynamics.body import Body
from torchrl_osr.lab.dynamics.model_adversary import ModelAdversary
from torchrl_osr.lab.dynamics.models import (
    DynamicsEnsemble,
    DynamicsLoss,
    TransitionVAE,
    TransitionVAELoss,
)
from torchrl_osr.lab.dynamics.options import DynamicsOptions, ModelData
from torchrl_osr.lab.dynamics.rollout_buffer import RolloutReplayBuffer
from torchrl_osr.lab.dynamics.rollouts import rollout, termination
from torchrl_osr.lab.dynamics.switching import EliteNetworks, SwitchingPolicy

__all__ = [
    "Body",
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
