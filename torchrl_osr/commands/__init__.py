"""The commands, one a file: ``torchrl-osr train`` is ``train.py``."""

from torchrl_osr.experiment import CONF

__all__ = ["CONF"]
