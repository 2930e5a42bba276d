"""Offline training on TorchRL's trainer."""

from torchrl_osr.trainers.interruption import Interrupted
from torchrl_osr.trainers.offline import (
    Evaluation,
    Hook,
    OfflineTrainer,
    divergence_warning,
)
from torchrl_osr.trainers.replay_buffer_collector import ReplayBufferCollector

__all__ = [
    "Evaluation",
    "Hook",
    "Interrupted",
    "OfflineTrainer",
    "ReplayBufferCollector",
    "divergence_warning",
]
