"""Three variants of OSR-v's constraint, as losses of a user's own.

Put this folder on PYTHONPATH, and train with
``loss=osr_v loss._target_=variants.RelativeLoss trust=[variants]``.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchrl_osr import OSRVLoss


class FixedTemperatureLoss(OSRVLoss):
    """The entropy temperature stays at ``alpha_init``."""

    def soft_actor_losses(self, *arguments: Any, **options: Any) -> Any:
        losses, metrics = super().soft_actor_losses(*arguments, **options)
        return losses | {"loss_alpha": 0 * losses["loss_alpha"]}, metrics


class HingedLoss(OSRVLoss):
    """The gap has the lower bound 0."""

    def data_values_and_gap(self, *arguments: Any) -> tuple[Tensor, Tensor]:
        values, gap = super().data_values_and_gap(*arguments)
        return values, gap.clamp(min=0)


class RelativeLoss(OSRVLoss):
    """The weight of the constraint is in units of the mean absolute value."""

    def data_values_and_gap(self, *arguments: Any) -> tuple[Tensor, Tensor]:
        values, gap = super().data_values_and_gap(*arguments)
        return values, gap * values.detach().abs().mean()
