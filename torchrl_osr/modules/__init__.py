"""Networks: actors, critics and inverse dynamics models."""

from torchrl_osr.modules.actor import (
    categorical_actor,
    deterministic_actor,
    gaussian_actor,
    tanh_gaussian_actor,
)
from torchrl_osr.modules.critic import (
    critic_ensemble,
    discrete_critic_ensemble,
    state_value,
)
from torchrl_osr.modules.inverse_dynamics import (
    categorical_inverse_dynamics,
    cvae_inverse_dynamics,
    tanh_gaussian_inverse_dynamics,
)

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
