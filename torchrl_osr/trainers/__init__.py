"""Offline training on TorchRL's trainer."""

from torchrl_osr.trainers.hardware import check_hardware
from torchrl_osr.trainers.interruption import Interrupted
from torchrl_osr.trainers.offline import OfflineTrainer, largest_value

__all__ = ["Interrupted", "OfflineTrainer", "check_hardware", "largest_value"]
