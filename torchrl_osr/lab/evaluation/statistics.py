"""Means of scores and their 95 % confidence intervals.

Shapes: ``E`` episodes of a run, ``K`` numbers of an episode, ``R`` resamples, ``N``
runs, ``T`` thresholds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

NUM_RESAMPLES = 2000
"""Bootstrap resamples of every interval."""

NORMAL_QUANTILE_975 = 1.959963984540054
"""A normal variable is below this many standard deviations with probability 0.975."""

TAIL = 50 * (1 - 0.95)
"""Percent of the resamples below an interval, and above it."""


def mean_interval(values: ArrayLike) -> tuple[float, float, float]:
    """Mean and its 95 % percentile-bootstrap interval.

    Args:
        values: independent results, returns of episodes for instance, ``[E]``.

    Returns:
        Mean, lower and upper end. With a single value all three are that value.

    Raises:
        ValueError: if there are no values, or some are not finite.

    Examples:
        >>> mean, low, high = mean_interval([1.0, 2.0, 3.0, 4.0])
        >>> mean, low <= mean <= high
        (2.5, True)
    """
    sample = _finite(values, "mean_interval").ravel()
    low, high = percentile_interval(stratified_resamples([sample]).mean(1))
    return float(sample.mean()), float(low), float(high)


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share, which keeps its coverage near 0 and 1.

    Args:
        count: successes.
        total: trials.

    Raises:
        ValueError: without trials, or with more successes than trials.

    Examples:
        >>> from torchrl_osr.lab.evaluation import wilson_interval
        >>> low, high = wilson_interval(20, 20)
        >>> round(low, 3), round(high, 3)
        (0.839, 1.0)
    """
    if not 0 <= count <= total or total < 1:
        raise ValueError(f"wilson_interval needs trials, got {count} of {total}.")
    square = NORMAL_QUANTILE_975**2
    centre = (count + square / 2) / (total + square)
    spread = math.sqrt(count * (total - count) / total + square / 4)
    half = NORMAL_QUANTILE_975 * spread / (total + square)
    return centre - half, min(centre + half, 1.0)


def percentile_interval(
    resamples: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ends of the 95 % percentile interval of resamples ``[R, ...]``."""
    low, high = np.percentile(resamples, [TAIL, 100 - TAIL], axis=0)
    return low, high


def nested_resamples(
    runs: Sequence[ArrayLike], *, seed: int = 0
) -> NDArray[np.float64]:
    """Bootstrap means over resampled runs and, in each of them, resampled episodes.

    The numbers of an episode stay together, so that a ratio or a difference of them is
    one of pairs. With one run only its episodes are resampled.

    Args:
        runs: numbers of the episodes of each run, ``[E, K]``; ``E`` may differ.

    Keyword Args:
        seed: of the resampling. Default 0.

    Returns:
        Means, every run with equal weight, ``[R, K]``.

    Raises:
        ValueError: if there are no runs, one has no episodes, or ``K`` differs.

    Examples:
        >>> resamples = nested_resamples([[[1.0, 5.0]] * 3, [[1.0, 5.0]] * 4])
        >>> resamples.shape, resamples[0].tolist()
        ((2000, 2), [1.0, 5.0])
    """
    tables = [np.asarray(run, dtype=np.float64) for run in runs]
    shapes = [table.shape for table in tables]
    if (
        not tables
        or any(table.ndim != 2 or not len(table) for table in tables)
        or len({each[1] for each in shapes}) > 1
    ):
        raise ValueError(f"nested_resamples needs episodes [E, K], got {shapes}.")
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(tables), size=(NUM_RESAMPLES, len(tables)))
    total = np.zeros((NUM_RESAMPLES, tables[0].shape[1]))
    for place in drawn.T:
        for number, table in enumerate(tables):
            rows = np.flatnonzero(place == number)
            size = len(table)
            # How often each episode is drawn: the same as drawing them, and faster.
            counts = rng.multinomial(size, np.full(size, 1 / size), size=len(rows))
            total[rows] += counts @ table / size
    return total / len(tables)


def stratified_resamples(strata: Sequence[ArrayLike]) -> NDArray[np.float64]:
    """Bootstrap resamples that keep the number of runs of every stratum.

    Args:
        strata: a number of each run, a sequence for each data set.

    Returns:
        The runs of all strata side by side, ``[R, N]``.

    Raises:
        ValueError: if there are no strata, or one of them is empty.
    """
    samples = [np.asarray(stratum, dtype=np.float64) for stratum in strata]
    if not samples or not all(sample.size for sample in samples):
        raise ValueError("stratified_resamples needs a value in every stratum.")
    rng = np.random.default_rng(0)
    resamples = [
        sample[rng.integers(sample.size, size=(NUM_RESAMPLES, sample.size))]
        for sample in samples
    ]
    return np.concatenate(resamples, axis=1)


def interquartile_mean(values: ArrayLike) -> NDArray[np.float64]:
    """Mean without the lowest and the highest quarter, over the last axis.

    As rliable has it (Agarwal et al., 2021, https://arxiv.org/abs/2108.13264): of ``N``
    values ``N // 4`` are left out at each end.

    Raises:
        ValueError: if there are no values, or some are not finite.

    Examples:
        >>> float(interquartile_mean([0.0, 3.0, 5.0, 1000.0]))
        4.0
    """
    ordered = np.sort(_finite(values, "interquartile_mean"), axis=-1)
    cut = ordered.shape[-1] // 4
    mean: NDArray[np.float64] = ordered[..., cut : ordered.shape[-1] - cut].mean(-1)
    return mean


def performance_profile(
    values: ArrayLike, thresholds: ArrayLike
) -> NDArray[np.float64]:
    """Share of values above each threshold, over the last axis.

    Args:
        values: scores, ``[..., N]``.
        thresholds: ``[T]``.

    Returns:
        Shares between 0 and 1, ``[..., T]``.

    Raises:
        ValueError: if there are no values, or some are not finite.

    Examples:
        >>> performance_profile([10.0, 20.0, 30.0, 40.0], [0.0, 20.0, 50.0]).tolist()
        [1.0, 0.5, 0.0]
    """
    table = _finite(values, "performance_profile")
    # One threshold after the other: all at once would fill the memory.
    shares = [(table > each).mean(-1) for each in np.asarray(thresholds)]
    return np.stack(shares, axis=-1)


def _finite(values: ArrayLike, name: str) -> NDArray[np.float64]:
    table = np.asarray(values, dtype=np.float64)
    if not table.size or not np.isfinite(table).all():
        raise ValueError(f"{name} needs finite values, got {table}.")
    return table
