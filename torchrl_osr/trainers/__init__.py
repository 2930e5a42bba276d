"""Offline training on TorchRL's trainer."""

from torchrl_osr.trainers.interruption import Interrupted
from torchrl_osr.trainers.offline import (
    Evaluation,
    Hook,
    OfflineTrainer,
    divergence_warning,
)

__all__ = ["Evaluation", "Hook", "Interrupted", "OfflineTrainer", "divergence_warning"]
