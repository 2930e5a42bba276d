"""Values that diverge, noticed early: long before they are infinite they are wrong."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

log = logging.getLogger(__name__)


class ValueLimits:
    """Warns once for each name whose logged mean exceeds its limit.

    Args:
        limits: largest plausible magnitude of a mean, by its name.
    """

    def __init__(self, limits: Mapping[str, float]) -> None:
        self._limits = dict(limits)

    def check(self, means: Mapping[str, float], where: str) -> None:
        """Warn of the means that exceed their limits for the first time.

        Args:
            means: of a log interval, by name.
            where: phase and step, for the message.
        """
        for name in [each for each in self._limits if each in means]:
            if abs(means[name]) <= self._limits[name]:
                continue
            log.warning(
                f"{where}: the mean {name} is {means[name]:.4g}; a magnitude above "
                f"{self._limits.pop(name):.4g} means that the values diverge. Lower "
                "the critics' learning rate (optim.qvalue_lr), or check the rewards "
                "and the discount. The run continues; this warning appears once."
            )


def largest_value(largest_reward: float, gamma: float) -> float:
    r"""Magnitude that learned values exceed only where they diverge.

    No policy's value is above :math:`\max|r| / (1 - \gamma)`, the discounted sum of the
    largest reward for ever. Learned values may be: the conservative penalty pushes them
    down, and errors are bootstrapped. Ten times as much is neither.

    Args:
        largest_reward: largest magnitude of a reward in the data.
        gamma: discount factor; with 1 there is no such magnitude.

    Examples:
        >>> from torchrl_osr.trainers import largest_value
        >>> round(largest_value(2.0, 0.99))
        2000
    """
    return 10 * largest_reward / (1 - gamma) if gamma < 1 else math.inf
