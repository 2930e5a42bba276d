"""Networks: actors, critics and inverse dynamics models."""

from torchrl_osr.modules.actor import (
    deterministic_actor,
    gaussian_actor,
    tanh_gaussian_actor,
)
from torchrl_osr.modules.critic import critic_ensemble, state_value
from torchrl_osr.modules.cvae_inverse_dynamics import cvae_inverse_dynamics
from torchrl_osr.modules.discrete import (
    categorical_actor,
    categorical_inverse_dynamics,
    discrete_critic_ensemble,
)
from torchrl_osr.modules.inverse_dynamics import tanh_gaussian_inverse_dynamics

__all__ = [
    "categorical_actor",
    "categorical_inverse_dynamics",
    "critic_ensemble",
    "cvae_inverse_dynamics",
    "deterministic_actor",
    "discrete_critic_ensemble",
    "gaussian_actor",
    "state_value",
    "tanh_gaussian_actor",
    "tanh_gaussian_inverse_dynamics",
]
