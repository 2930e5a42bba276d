"""The commands, one a file: ``torchrl-osr train`` is ``train.py``."""

from torchrl_osr.lab.run import CONF

__all__ = ["CONF"]
