"""Means, shares and differences with their 95 % confidence intervals.

All intervals of the package come from here. Bootstraps have fixed seeds: the same
numbers give the same interval. Shapes: ``E`` episodes of a run, ``K`` numbers of an
episode, ``R`` resamples, ``N`` seeds, ``M`` states, ``W`` walks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]

NUM_RESAMPLES, NUM_SHARE_RESAMPLES = 2000, 10_000
"""Bootstrap resamples of means, and of shares of states."""

NORMAL_QUANTILE_975 = 1.959963984540054
TAIL = 50 * (1 - 0.95)
"""Percentage of the resamples below an interval, and above it."""


class Estimate(NamedTuple):
    """A mean with its 95 % interval.

    ``over`` is what was resampled: ``"seeds"``, ``"two seeds"``, or ``"episodes"`` or
    ``"walks"`` of a single seed.
    """

    mean: float
    low: float
    high: float
    over: str = "seeds"

    def __str__(self) -> str:
        return f"{decimal(self.mean)} {self.interval()}"

    def interval(self, sign: str = "") -> str:
        """Format the interval, with a mark if it is not over seeds."""
        mark = {"seeds": "", "two seeds": " ²"}.get(self.over, " ᵉ")
        return f"[{decimal(self.low, sign)}, {decimal(self.high, sign)}]{mark}"


def decimal(value: float, sign: str = "") -> str:
    """Format with one decimal; ``sign="+"`` marks positive numbers, too."""
    # A minus sign, unlike a hyphen, stays with its number at the end of a line.
    return f"{value:{sign}z.1f}".replace("-", "\N{MINUS SIGN}")


def over_what(groups: Sequence[Sequence[object]], alone: str = "episodes") -> str:
    """Return an estimate's ``over`` for the runs of each data set."""
    return {1: alone, 2: "two seeds"}.get(min(map(len, groups)), "seeds")


def percentile_interval(resamples: Array) -> tuple[Array, Array]:
    """Return both ends of the 95 % interval of resamples ``[R, ...]``."""
    low, high = np.percentile(resamples, [TAIL, 100 - TAIL], axis=0)
    return low, high


def interval(point: float, resamples: ArrayLike, over: str = "seeds") -> Estimate:
    """Return a number with the interval of its resamples ``[R]``."""
    low, high = percentile_interval(np.asarray(resamples, np.float64))
    return Estimate(float(point), float(low), float(high), over)


def mean_interval(values: ArrayLike) -> tuple[float, float, float]:
    """Return the mean of ``[E]`` values and its 95 % percentile-bootstrap interval.

    Raises:
        ValueError: if there are no values, or some are not finite.

    Examples:
        >>> mean, low, high = mean_interval([1.0, 2.0, 3.0, 4.0])
        >>> mean, low <= mean <= high
        (2.5, True)
    """
    sample = np.asarray(values, np.float64).ravel()
    if not sample.size or not np.isfinite(sample).all():
        raise ValueError(f"mean_interval needs finite values, got {sample}.")
    rows = np.random.default_rng(0).integers(
        sample.size, size=(NUM_RESAMPLES, sample.size)
    )
    return interval(sample.mean(), sample[rows].mean(1))[:3]


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share, which is also right near 0 and 1.

    Examples:
        >>> low, high = wilson_interval(20, 20)
        >>> round(low, 3), round(high, 3)
        (0.839, 1.0)
    """
    square = NORMAL_QUANTILE_975**2
    centre = (count + square / 2) / (total + square)
    spread = math.sqrt(count * (total - count) / total + square / 4)
    half = NORMAL_QUANTILE_975 * spread / (total + square)
    return centre - half, min(centre + half, 1.0)


def nested_resamples(runs: Sequence[ArrayLike], *, seed: int = 0) -> Array:
    """Resample runs and then their episodes, and return the means ``[R, K]``.

    Each run ``[E, K]`` has its own ``E`` and equal weight. The numbers of an episode
    stay together, so that their ratios and differences are paired.
    """
    tables = [np.asarray(run, dtype=np.float64) for run in runs]
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


def estimate(runs: Sequence[Array]) -> Estimate:
    """Return the mean over runs ``[E]``; a single run's interval is over episodes."""
    over = over_what([runs])
    values = runs[0] if over == "episodes" else [run.mean() for run in runs]
    return Estimate(*mean_interval(values), over)


def mean_difference(data_sets: Sequence[Sequence[Array]]) -> Estimate:
    """Return the mean of the differences ``[E]`` of each data set's seeds.

    Data sets have equal weight, and so have the seeds of each.
    """
    point = np.mean([np.mean([run.mean() for run in each]) for each in data_sets])
    # A seed for each data set: with one, they would be drawn alike.
    resamples = [
        nested_resamples([run[:, None] for run in each], seed=index)
        for index, each in enumerate(data_sets)
    ]
    mean = np.mean(resamples, axis=0).ravel()
    return interval(float(point), mean, over_what(data_sets))


def decrease_interval(
    clean: ArrayLike, disturbed: ArrayLike
) -> tuple[float | None, float | None, float | None]:
    """Return the decrease of the mean in percent and its paired-bootstrap interval.

    All three are ``None`` for fewer than two pairs, or if the clean mean is not above
    0; both ends are ``None`` if it is not above 0 in a resample.

    Examples:
        >>> decrease_interval([40.0, 60.0], [20.0, 30.0])
        (50.0, 50.0, 50.0)
    """
    pairs = np.stack([np.asarray(clean, float), np.asarray(disturbed, float)])
    if pairs.shape[1] < 2 or pairs[0].mean() <= 0:
        return None, None, None
    clean_mean, disturbed_mean = pairs.mean(1)
    rng = np.random.default_rng(0)
    rows = rng.integers(pairs.shape[1], size=(NUM_RESAMPLES, pairs.shape[1]))
    resampled_clean, resampled = pairs[:, rows].mean(-1)
    point = float(100 * (1 - disturbed_mean / clean_mean))
    if (resampled_clean <= 0).any():
        return point, None, None
    return interval(point, 100 * (1 - resampled / resampled_clean))[:3]


def scores_and_decreases(
    runs: Sequence[ArrayLike],
) -> list[tuple[Estimate, Estimate | None]]:
    """Return ``K`` mean scores, and their decreases in percent of the first, clean one.

    Runs are ``[E, K]``. Decreases are ``None`` if a clean mean is not above 0.
    """
    over = over_what([runs])
    means = np.mean([np.mean(np.asarray(run, float), axis=0) for run in runs], axis=0)
    resamples = nested_resamples(runs)
    positive = means[0] > 0 and (resamples[:, 0] > 0).all()
    found: list[tuple[Estimate, Estimate | None]] = []
    for mean, column in zip(means, resamples.T, strict=True):
        lost = (100 * (1 - mean / means[0]), 100 * (1 - column / resamples[:, 0]), over)
        found.append(
            (interval(mean, column, over), interval(*lost) if positive else None)
        )
    return found


def saved_share(back: ArrayLike, walk: ArrayLike) -> tuple[float, float, float]:
    """Return the recovery rate over states, with its 95 % interval.

    ``back`` ``[N, M]`` has the rate of each seed and state. Seeds are resampled, and
    walks with all of their states. If the rate is 0 or 1 everywhere, the interval is
    Wilson's, with the walks as trials.

    Examples:
        >>> saved_share([[1, 0, 1, 0]], walk=[0, 0, 1, 1])
        (0.5, 0.5, 0.5)
        >>> share, low, high = saved_share([[0, 0, 0, 0]], walk=[0, 1, 2, 3])
        >>> share, low, round(high, 2)
        (0.0, 0.0, 0.49)
    """
    table, sizes = _by_walk(back, walk)
    for share, whole in ((0.0, 0.0 * sizes), (1.0, sizes)):
        if (table == whole).all():
            return (share, *wilson_interval(round(share * len(sizes)), len(sizes)))
    seeds, walks = _weights(len(table), len(sizes))
    shares = ((seeds @ table) * walks).sum(-1) / len(table) / (walks @ sizes)
    return interval(shares[0], shares[1:])[:3]


def recovered_share(
    method: ArrayLike, baseline: ArrayLike, walk: ArrayLike
) -> tuple[float, float, float]:
    r"""Return R, the share of the baseline's failures that a method avoids.

    .. math::
        R = \frac{p_{method} - p_{baseline}}{1 - p_{baseline}}

    with the recovery rates :math:`p`, see :func:`saved_share`. Rows ``[N, M]`` of
    method and baseline have the same seed.

    Raises:
        ValueError: if the baseline saves all states, in the data or in a resample.

    Examples:
        >>> recovered_share([[1, 1, 1, 0]], [[1, 0, 0, 0]], walk=[5, 5, 5, 5])[0]
        0.6666666666666666
    """
    ours, sizes = _by_walk(method, walk)
    theirs, _ = _by_walk(baseline, walk)
    seeds, walks = _weights(len(ours), len(sizes))
    saved, before = (((seeds @ of) * walks).sum(-1) / len(of) for of in (ours, theirs))
    lost = walks @ sizes - before
    if (lost <= 0).any():
        raise ValueError("The baseline saves all states: R is not defined.")
    shares = (saved - before) / lost
    return interval(shares[0], shares[1:])[:3]


def _by_walk(table: ArrayLike, walk: ArrayLike) -> tuple[Array, Array]:
    """Return sums over the states of each walk ``[N, W]``, and their number ``[W]``."""
    walks, number = np.unique(np.asarray(walk), return_inverse=True)
    member = np.eye(len(walks))[number]
    return np.asarray(table, np.float64) @ member, member.sum(0)


def _weights(*sizes: int) -> list[Array]:
    """Return how often each is drawn: once, then per resample, ``[1 + R, size]``."""
    rng = np.random.default_rng(0)
    draws = (
        rng.multinomial(size, np.full(size, 1 / size), NUM_SHARE_RESAMPLES)
        for size in sizes
    )
    # In floating point: products of integers are slow.
    return [np.concatenate([np.ones((1, each.shape[1])), each]) for each in draws]
