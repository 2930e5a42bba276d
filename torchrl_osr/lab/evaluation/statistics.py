"""Means, shares and differences with their 95 % confidence intervals.

All intervals of the package come from here. Bootstraps have fixed seeds: the same
numbers give the same interval. Shapes: ``E`` episodes of a run, ``K`` numbers of an
episode, ``R`` resamples, ``N`` seeds, ``M`` states, ``W`` walks.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]

NUM_RESAMPLES = 2000
"""Of bootstraps of means; those of shares of states have 10,000."""

NORMAL_QUANTILE_975 = 1.959963984540054
STUDENT_QUANTILE_975 = 4.302652729911275  # two degrees of freedom


class Estimate(NamedTuple):
    """A mean with its 95 % interval.

    ``over`` names the resampled units: ``"seeds"``, ``"two seeds"``, or ``"episodes"``
    or ``"walks"`` of a single seed.
    """

    mean: float
    low: float
    high: float
    over: str = "seeds"

    def __str__(self) -> str:
        return format(self)

    def __format__(self, sign: str) -> str:
        """Format mean and interval, with a mark if it is not over seeds."""
        mean, low, high = (decimal(each, sign) for each in self[:3])
        mark = {"seeds": "", "two seeds": " ²"}.get(self.over, " ᵉ")
        return f"{mean} [{low}, {high}]{mark}"


def decimal(value: float, sign: str = "") -> str:
    """Format with one decimal; ``sign="+"`` marks positive numbers, too."""
    # A minus sign, unlike a hyphen, stays with its number at the end of a line.
    return f"{value:{sign}z.1f}".replace("-", "\N{MINUS SIGN}")


def over_what(seeds: int, alone: str = "episodes") -> str:
    """Return an estimate's ``over``; of a single seed it is ``alone``."""
    return {1: alone, 2: "two seeds"}.get(seeds, "seeds")


def interval(point: float, resamples: ArrayLike, over: str = "seeds") -> Estimate:
    """Return a number with the interval of its resamples ``[R]``."""
    low, high = np.percentile(np.asarray(resamples, np.float64), [2.5, 97.5])
    return Estimate(float(point), float(low), float(high), over)


def mean_interval(values: ArrayLike) -> tuple[float, float, float]:
    """Return the mean of ``[E]`` values and its 95 % percentile-bootstrap interval."""
    sample = np.asarray(values, np.float64).ravel()
    if not sample.size or not np.isfinite(sample).all():
        raise ValueError(f"an interval needs finite values, got {sample}.")
    rng, size = np.random.default_rng(0), sample.size
    sizes = map(len, np.array_split(range(NUM_RESAMPLES), 1 + size // 1000))
    means = [sample[rng.integers(size, size=(n, size))].mean(1) for n in sizes]
    return interval(sample.mean(), np.concatenate(means))[:3]


def nested_resamples(runs: Sequence[ArrayLike], *, seed: int = 0) -> Array:
    """Resample runs ``[E, K]`` and episodes; return the means ``[R, K]``.

    Runs have equal weight. The numbers of an episode stay together. Runs with as many
    episodes play the same ones, which are drawn alike.
    """
    tables = [np.asarray(run, dtype=np.float64) for run in runs]
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(tables), size=(NUM_RESAMPLES, len(tables)))
    # How often each episode is drawn: the same as drawing them, and faster.
    share = {
        size: rng.multinomial(size, np.full(size, 1 / size), NUM_RESAMPLES) / size
        for size in sorted({*map(len, tables)})
    }
    means = np.stack([share[len(table)] @ table for table in tables])
    return means[drawn, np.arange(NUM_RESAMPLES)[:, None]].mean(1)


def estimate(runs: Sequence[Array]) -> Estimate:
    """Return the mean over runs ``[E]``; a single run's interval is over episodes."""
    values = runs[0] if len(runs) == 1 else [run.mean() for run in runs]
    return Estimate(*mean_interval(values), over_what(len(runs)))


def nested_mean(data_sets: Sequence[Sequence[Array]]) -> Estimate:
    """Return the mean over data sets, their seeds, and the episodes ``[E]`` of these.

    Data sets have equal weight, and so have the seeds of each.
    """
    point = np.mean([np.mean([run.mean() for run in each]) for each in data_sets])
    # A seed for each data set: with one, they would be drawn alike.
    resamples = [
        nested_resamples([run[:, None] for run in each], seed=index)
        for index, each in enumerate(data_sets)
    ]
    over = over_what(min(map(len, data_sets)))
    return interval(float(point), np.mean(resamples, axis=0).ravel(), over)


def mean_of_networks(values: ArrayLike) -> Estimate:
    """Return the mean of ``[N, E]`` values, for one or three networks.

    Each network is trained on a bootstrap sample of the data. So it differs from the
    estimate as that differs from the truth: Student's prediction interval. The interval
    over episodes adds to it in squares.
    """
    table, half = np.asarray(values, np.float64), 0.0
    if len(table) > 1:
        half = STUDENT_QUANTILE_975 * table.mean(1).std(ddof=1) * sqrt(1 + 1 / 3)
    mean, low, high = mean_interval(table.mean(0))
    ends = mean - hypot(mean - low, half), mean + hypot(high - mean, half)
    return Estimate(mean, *ends, over_what(len(table)))


def scores_and_decreases(
    runs: Sequence[ArrayLike],
) -> list[tuple[Estimate, Estimate | None]]:
    """Return ``K`` mean scores, and their decreases in percent of the first, clean one.

    Runs are ``[E, K]``. Decreases are ``None`` if a clean mean is not well above 0: a
    resample is below a tenth of it.
    """
    over = over_what(len(runs))
    means = np.mean([np.mean(np.asarray(run, float), axis=0) for run in runs], axis=0)
    resamples = nested_resamples(runs)
    positive = means[0] > 0 and (resamples[:, 0] > means[0] / 10).all()
    found: list[tuple[Estimate, Estimate | None]] = []
    for mean, column in zip(means, resamples.T, strict=True):
        lost = None
        if positive:
            shares = 100 * (1 - column / resamples[:, 0])
            lost = interval(100 * (1 - mean / means[0]), shares, over)
        found.append((interval(mean, column, over), lost))
    return found


def wilson(successes: float, trials: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share."""
    share, square = successes / trials, NORMAL_QUANTILE_975**2 / trials
    half = sqrt(square * (share * (1 - share) + square / 4))
    low, high = (share + square / 2 + sign * half for sign in (-1, 1))
    return max(0.0, low / (1 + square)), min(1.0, high / (1 + square))


def never_certain(percent: Estimate, trials: int) -> Estimate:
    """Return a share with Wilson's interval if no resample differs from it."""
    if percent.high - percent.low > 1e-9:
        return percent
    low, high = wilson(percent.mean / 100 * trials, trials)
    return percent._replace(low=100 * low, high=100 * high)


def recovered_share(
    back: ArrayLike, walk: ArrayLike, baseline: ArrayLike | None = None
) -> Estimate:
    """Return the recovery rate over states, in percent.

    ``back`` ``[N, M]`` has the rate of each seed and state. Seeds are resampled, and
    walks with all of their states. If no resample differs, the interval is Wilson's,
    with the walks as trials.

    With the rates of a ``baseline``, of the same seeds, return R instead: the share of
    the baseline's failures that is avoided.

    Raises:
        ValueError: if the baseline saves all states, in the data or in a resample.
    """
    walks, number = np.unique(np.asarray(walk), return_inverse=True)
    member = np.eye(len(walks))[number]
    sizes, ours = member.sum(0), np.asarray(back, np.float64) @ member
    theirs, over = 0 * ours, over_what(len(ours), alone="walks")
    if baseline is not None:
        theirs = np.asarray(baseline, np.float64) @ member
    rng = np.random.default_rng(0)
    # How often each seed and walk is drawn: once, then in each resample.
    by_seed, by_walk = (
        np.vstack([np.ones(size), rng.multinomial(size, [1 / size] * size, 10_000)])
        for size in ours.shape
    )
    saved, before = (
        ((by_seed @ each) * by_walk).sum(-1) / len(each) for each in (ours, theirs)
    )
    lost = by_walk @ sizes - before
    if (lost <= 0).any():
        raise ValueError("The baseline saves all states: R is not defined.")
    shares = 100 * (saved - before) / lost
    found = interval(shares[0], shares[1:], over)
    return found if baseline is not None else never_certain(found, len(walks))
