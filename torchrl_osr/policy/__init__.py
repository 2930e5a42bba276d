"""A trained policy by itself: loaded, called, saved to one file, exported."""

from torchrl_osr.policy.from_loss import policy_from_loss
from torchrl_osr.policy.policy import Policy, load_policy

__all__ = ["Policy", "load_policy", "policy_from_loss"]
