"""What is known of a data set that was never in memory as a whole.

Each chunk gives its part, which JSON can hold bit by bit, and the parts are merged.

Shapes: ``N`` rows of a chunk, ``S`` observation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from tensordict import TensorDictBase

from torchrl_osr.data.validation import REWARD_KEY, VECTOR_KEYS, zero_everywhere


def statistics_of(data: TensorDictBase) -> dict[str, Any]:
    """Return a chunk's part.

    Args:
        data: checked transitions ``[N]``, at least one.

    Returns:
        ``rows``; of the observations ``mean`` and ``squares``, the sum of squared
        distances to it, in float64; ``reward``, the lowest and the highest;
        ``nonzero``, which vectors are not zero everywhere; and ``action_size``.
    """
    observation, reward = data["observation"].double(), data.get(REWARD_KEY)
    mean = observation.mean(0)
    return {
        "rows": len(data),
        "action_size": data["action"].shape[-1],
        "mean": mean.tolist(),
        "squares": (observation - mean).square().sum(0).tolist(),
        "reward": [reward.min().item(), reward.max().item()],
        "nonzero": [bool((data.get(key) != 0).any()) for key in VECTOR_KEYS],
    }


def merged(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    r"""Return the statistics of all chunks.

    Means and sums of squares :math:`M` are merged by Chan's formula, which cancels no
    digits, however far the mean is from zero:

    .. math::
        M = M_A + M_B + \frac{n_A n_B}{n_A + n_B} (\bar x_B - \bar x_A)^2

    Args:
        parts: what :func:`statistics_of` gave.

    Returns:
        ``observation`` with ``mean`` and ``std``, ``S`` numbers each; ``reward`` with
        ``min`` and ``max``.

    Raises:
        ValueError: an observation, next observation or action is zero everywhere.
    """
    count, mean, squares = 0, np.zeros(1), np.zeros(1)
    for part in parts:
        rows = part["rows"]
        delta = np.asarray(part["mean"]) - mean
        squares = squares + part["squares"] + delta**2 * (count * rows / (count + rows))
        mean = mean + delta * (rows / (count + rows))
        count += rows
    for number, key in enumerate(VECTOR_KEYS):
        if not any(part["nonzero"][number] for part in parts):
            raise zero_everywhere(key, count)
    std = np.sqrt(squares / count)
    return {
        "observation": {"mean": mean.tolist(), "std": std.tolist()},
        "reward": {
            "min": min(part["reward"][0] for part in parts),
            "max": max(part["reward"][1] for part in parts),
        },
    }
