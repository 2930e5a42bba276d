"""Target networks that follow, in one call."""

from __future__ import annotations

import functools

import torch
from torch import Tensor
from torchrl import objectives


class SoftUpdate(objectives.SoftUpdate):
    r"""TorchRL's :class:`~torchrl.objectives.SoftUpdate`, faster, with the same bits.

    :math:`\bar\theta \leftarrow \bar\theta + \tau (\theta - \bar\theta)`. TorchRL
    0.14.1 goes through nested tensordicts at every step, which takes ten times as long
    as the arithmetic of small networks.
    """

    @torch.no_grad()
    def step(self) -> None:
        """Move all targets."""
        targets, sources = self._pairs
        torch._foreach_lerp_(targets, sources, 1 - self.eps)

    @functools.cached_property
    def _pairs(self) -> tuple[list[Tensor], list[Tensor]]:
        """Targets and their sources, which are updated in place ever after."""
        pairs = [
            (self._targets[f"target_{name}", *rest], source)
            for (name, *rest), source in self._sources.items(True, True)
        ]
        targets, sources = zip(*pairs, strict=True)
        return list(targets), list(sources)
