"""A trained policy alone: load it, call it, save it to one file, export it."""

from torchrl_osr.policy.from_loss import policy_from_loss
from torchrl_osr.policy.monitor import DataMonitor, fit_monitor
from torchrl_osr.policy.policy import Policy, load_policy

__all__ = ["DataMonitor", "Policy", "fit_monitor", "load_policy", "policy_from_loss"]
