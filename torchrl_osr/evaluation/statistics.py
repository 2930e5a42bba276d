"""Means and intervals that a claim can stand on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def mean_interval(
    values: ArrayLike,
    *,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float, float]:
    """Return the mean and its percentile-bootstrap confidence interval.

    Args:
        values: independent results, returns of episodes for instance, ``[E]``.

    Keyword Args:
        confidence: coverage of the interval. Default 0.95.
        num_resamples: bootstrap resamples. Default 2000.
        seed: of the resampling. Default 0.

    Returns:
        Mean, lower and upper end. With a single value all three are that value.

    Raises:
        ValueError: if there are no values, or some are not finite.

    Examples:
        >>> mean, low, high = mean_interval([1.0, 2.0, 3.0, 4.0])
        >>> mean, low <= mean <= high
        (2.5, True)
    """
    sample = np.asarray(values, dtype=np.float64).ravel()
    if not sample.size or not np.isfinite(sample).all():
        raise ValueError(f"mean_interval needs finite values, got {sample}.")
    rng = np.random.default_rng(seed)
    resamples = sample[rng.integers(sample.size, size=(num_resamples, sample.size))]
    tail = 50 * (1 - confidence)
    low, high = np.percentile(resamples.mean(1), [tail, 100 - tail])
    return float(sample.mean()), float(low), float(high)
