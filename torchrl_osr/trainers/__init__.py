"""Offline training on TorchRL's trainer."""

from torchrl_osr.trainers.offline import OfflineTrainer

__all__ = ["OfflineTrainer"]
