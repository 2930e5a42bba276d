"""Values that run away, said early: long before they are infinite they are wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torchrl import torchrl_logger


class ValueBounds:
    """Warns, once for each name, of a logged mean that is larger than it can be.

    Args:
        bounds: the largest plausible magnitude of a mean, by its name.
    """

    def __init__(self, bounds: Mapping[str, float]) -> None:
        self._bounds = dict(bounds)

    def check(self, means: Mapping[str, float], where: str) -> None:
        """Warn of what is out of its bound for the first time.

        Args:
            means: of a tick, by name.
            where: phase and step, in words.
        """
        for name in [each for each in self._bounds if each in means]:
            if abs(means[name]) <= self._bounds[name]:
                continue
            torchrl_logger.warning(
                f"{where}: the mean {name} is {means[name]:.4g}, more than "
                f"{self._bounds.pop(name):.4g} in magnitude can hardly be right: the "
                "values diverge. Lower the critics' learning rate (optim.qvalue_lr), "
                "or look at the rewards and the discount. The run goes on; this is "
                "said once."
            )


def largest_value(largest_reward: float, gamma: float) -> float:
    r"""Return a magnitude that values exceed only where they diverge.

    No policy's value is above :math:`\max|r| / (1 - \gamma)`, the sum of the largest
    reward for ever. Learned values are not any policy's: the conservative penalty
    pushes them below, and errors are bootstrapped. Ten times as much is neither.

    Args:
        largest_reward: the largest magnitude in the data.
        gamma: discount factor; with 1 there is no such magnitude.

    Examples:
        >>> from torchrl_osr.trainers.value_bounds import largest_value
        >>> round(largest_value(2.0, 0.99))
        2000
    """
    return 10 * largest_reward / (1 - gamma) if gamma < 1 else math.inf
