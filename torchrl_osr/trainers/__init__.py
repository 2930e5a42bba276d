"""Offline training on TorchRL's trainer."""

from torchrl_osr.trainers.interruption import Interrupted
from torchrl_osr.trainers.offline import Evaluation, OfflineTrainer, largest_value
from torchrl_osr.trainers.replay_buffer_collector import ReplayBufferCollector

__all__ = [
    "Evaluation",
    "Interrupted",
    "OfflineTrainer",
    "ReplayBufferCollector",
    "largest_value",
]
