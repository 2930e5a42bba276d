"""Offline training on TorchRL's trainer."""

from torchrl_osr.trainers.offline import OfflineTrainer
from torchrl_osr.trainers.together import train_together

__all__ = ["OfflineTrainer", "train_together"]
