"""Networks: the actor, the critics and the inverse dynamics model."""

from torchrl_osr.modules.actor import tanh_gaussian_actor
from torchrl_osr.modules.critic import critic_ensemble
from torchrl_osr.modules.inverse_dynamics import tanh_gaussian_inverse_dynamics

__all__ = ["critic_ensemble", "tanh_gaussian_actor", "tanh_gaussian_inverse_dynamics"]
