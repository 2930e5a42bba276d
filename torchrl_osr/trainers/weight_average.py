"""An exponential average of a network's weights."""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn


class WeightAverage:
    r"""Average of a network's weights over its last updates.

    .. math::
        \bar\theta_n = \bar\theta_{n-1} + \max\!\Big(\text{share},
        \frac{10}{n + 9}\Big) (\theta_n - \bar\theta_{n-1})

    The first weights of an exponential average stay in it for longer than a short run
    lasts. The second share leaves them out: until update ``10 / share`` the average is
    of about the last tenth of all updates. The arithmetic is that of
    :class:`torch.optim.swa_utils.AveragedModel`, which looks for the parameters anew at
    every update and takes ten times as long for small networks.

    Args:
        network: whose parameters are updated in place.
        share: of the new weights in the average; 1 for the weights themselves.

    Attributes:
        network: a copy with the average.

    Examples:
        >>> import torch
        >>> from torchrl_osr.trainers import WeightAverage
        >>> network = torch.nn.Linear(1, 1, bias=False)
        >>> average = WeightAverage(network, share=0.25)
        >>> for step in range(1, 101):
        ...     _ = torch.nn.init.constant_(network.weight, step)
        ...     average.update(step)
        >>> round(average.network.weight.item(), 3)  # 100 less (1 - share) / share
        97.0
    """

    def __init__(self, network: nn.Module, share: float) -> None:
        self.network, self.share = deepcopy(network), share
        self._average: list[Tensor] = list(self.network.parameters())
        self._weights: list[Tensor] = list(network.parameters())

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the weights after update number ``step``, from 1 on."""
        share = max(self.share, 10 / (step + 9))
        torch._foreach_lerp_(self._average, self._weights, share)
