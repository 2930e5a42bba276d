"""Offline training on TorchRL's trainer."""

from torchrl_osr.fast import SoftUpdate
from torchrl_osr.trainers.hardware import check_hardware
from torchrl_osr.trainers.interruption import Interrupted
from torchrl_osr.trainers.offline import OfflineTrainer, largest_value
from torchrl_osr.trainers.replay_buffer_collector import ReplayBufferCollector
from torchrl_osr.trainers.schedule import learning_rates
from torchrl_osr.trainers.weight_average import WeightAverage

__all__ = [
    "Interrupted",
    "OfflineTrainer",
    "ReplayBufferCollector",
    "SoftUpdate",
    "WeightAverage",
    "check_hardware",
    "largest_value",
    "learning_rates",
]
