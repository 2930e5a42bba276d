"""Scores of runs without a disturbance: means, profiles and interquartile means.

Shapes: ``C`` checkpoints, ``E`` episodes, ``T`` thresholds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.data import normalized_score
from torchrl_osr.evaluation import (
    NUM_RECENT,
    interquartile_mean,
    mean_interval,
    nested_resamples,
    percentile_interval,
    performance_profile,
    stratified_resamples,
)
from torchrl_osr.report.checks import cells, data_of, methods_of
from torchrl_osr.report.runs import Run

Array = NDArray[np.float64]
Evaluations = Sequence[Mapping[str, Any]]


def decimal(value: float, sign: str = "") -> str:
    """Return a number with one decimal, and a minus that no line breaks behind.

    Args:
        value: the number.
        sign: ``"+"`` shows that of positive numbers, too.
    """
    return f"{value:{sign}.1f}".replace("-", "\N{MINUS SIGN}")


class Estimate(NamedTuple):
    """A mean with its 95 % interval.

    Attributes:
        mean: of the runs.
        low: lower end.
        high: upper end.
        over: what was resampled: "seeds", or "episodes" where a data set has one seed.
    """

    mean: float
    low: float
    high: float
    over: str = "seeds"

    def __str__(self) -> str:
        """Return ``"mean [low, high]"``, with a mark if not over seeds."""
        return f"{decimal(self.mean)} {self.interval}"

    @property
    def interval(self) -> str:
        """``"[low, high]"``, with a mark if not over seeds."""
        mark = "" if self.over == "seeds" else " ᵉ"
        return f"[{decimal(self.low)}, {decimal(self.high)}]{mark}"


class Curve(NamedTuple):
    """A number along an axis, with its 95 % band.

    Attributes:
        x: places, ``[T]``.
        mean: ``[T]``.
        low: lower end, ``[T]``.
        high: upper end, ``[T]``.
        over: what was resampled, or "" where there is no band.
    """

    x: Array
    mean: Array
    low: Array
    high: Array
    over: str


def episode_scores(run: Run, evaluations: Evaluations) -> Array:
    """Return the score of each start state, over the evaluations, ``[E]``.

    Evaluations start in the same states again, so they are no new episodes.

    Raises:
        ValueError: if they do not.
    """
    if any(row["seeds"] != evaluations[0]["seeds"] for row in evaluations):
        raise ValueError(f"{run.folder}: evaluations have different episode seeds.")
    returns = np.array([row["returns"] for row in evaluations], dtype=np.float64)
    scores: Array = normalized_score(run.env, returns.mean(0))
    return scores


def estimate(runs: Sequence[Array]) -> Estimate:
    """Return the mean over runs and its interval.

    Args:
        runs: scores of each run's episodes, ``[E]``.

    Returns:
        Interval over the runs' means; with one run, over its episodes.
    """
    if len(runs) == 1:
        return Estimate(*mean_interval(runs[0]), over="episodes")
    return Estimate(*mean_interval([run.mean() for run in runs]))


def over_what(groups: Sequence[Sequence[object]]) -> str:
    """Return what an interval is over: seeds, if each data set has several.

    Args:
        groups: something of each seed, data set by data set.
    """
    return "seeds" if min(map(len, groups)) > 1 else "episodes"


def last_score(runs: Sequence[Run]) -> Estimate:
    """Return the score of the last evaluation."""
    return estimate([episode_scores(run, run.evaluations[-1:]) for run in runs])


def recent_score(runs: Sequence[Run]) -> Estimate:
    """Return the mean score of the last evaluations."""
    return estimate([recent_episodes(run) for run in runs])


def recent_episodes(run: Run) -> Array:
    """Return episode scores, over the last evaluations, ``[E]``."""
    return episode_scores(run, run.evaluations[-NUM_RECENT:])


def learning_curve(runs: Sequence[Run]) -> Curve:
    """Return the score along the steps; the runs were evaluated at the same."""
    rows = [
        estimate([episode_scores(run, [run.evaluations[index]]) for run in runs])
        for index in range(len(runs[0].evaluations))
    ]
    steps = np.array([row["step"] for row in runs[0].evaluations], dtype=np.float64)
    mean, low, high = (np.array([row[end] for row in rows]) for end in range(3))
    return Curve(steps, mean, low, high, rows[0].over)


def interquartile_means(runs: Sequence[Run]) -> dict[str, Estimate]:
    """Return each method's IQM over data sets and seeds.

    Runs are resampled within their data sets. Where one of these has no second seed
    that is impossible, and the interval is over the runs' episodes instead.
    """
    found = {}
    for method in methods_of(runs):
        strata = _strata(runs, method)
        scores = [[recent_episodes(run).mean() for run in group] for group in strata]
        point = float(interquartile_mean(np.concatenate(scores)))
        over = over_what(strata)
        if over == "seeds":
            resamples = stratified_resamples(scores)
        else:
            episodes = [recent_episodes(run) for group in strata for run in group]
            draws = [_of_run(each, seed) for seed, each in enumerate(episodes)]
            resamples = np.concatenate(draws, axis=1)
        low, high = percentile_interval(interquartile_mean(resamples))
        found[method] = Estimate(point, float(low), float(high), over)
    return found


def run_profile(runs: Sequence[Run], method: str, thresholds: Array) -> Curve:
    """Return the share of a method's runs above each score."""
    strata = _strata(runs, method)
    scores = [[recent_episodes(run).mean() for run in group] for group in strata]
    mean = performance_profile(np.concatenate(scores), thresholds)
    if over_what(strata) != "seeds":
        return Curve(thresholds, mean, mean, mean, "")
    resamples = performance_profile(stratified_resamples(scores), thresholds)
    return Curve(thresholds, mean, *percentile_interval(resamples), "seeds")


def episode_profile(runs: Sequence[Run], method: str, thresholds: Array) -> Curve:
    """Return the share of a method's episodes above each score.

    Every data set counts the same; within it seeds are resampled, then episodes.
    """
    tables = [
        [_above(run, thresholds) for run in group] for group in _strata(runs, method)
    ]
    mean = np.mean([np.mean([run.mean(0) for run in each], axis=0) for each in tables],
                   axis=0)  # fmt: skip
    # A seed for each data set: with one, they would be drawn alike.
    resamples = [nested_resamples(each, seed=seed) for seed, each in enumerate(tables)]
    low, high = percentile_interval(np.mean(resamples, axis=0))
    return Curve(thresholds, mean, low, high, over_what(tables))


def thresholds_of(runs: Sequence[Run], number: int = 121) -> Array:
    """Return thresholds from 0, or the lowest score of an episode, to the highest."""
    scores = np.concatenate([_recent_table(run).ravel() for run in runs])
    return np.linspace(min(0.0, scores.min()), scores.max(), number)


def coverage(runs: Sequence[Run], method: str) -> str:
    """Return on how many of the data sets a method has runs; "" if on all."""
    have, there = len(_strata(runs, method)), len(data_of(runs))
    return "" if have == there else f"{have} of {there} data sets"


def _strata(runs: Sequence[Run], method: str) -> list[list[Run]]:
    """Return a method's runs, data set by data set."""
    return [group for (_, name), group in cells(runs).items() if name == method]


def _of_run(episodes: Array, seed: int) -> Array:
    """Return the mean of a run whose episodes are resampled, ``[R, 1]``."""
    return nested_resamples([episodes[:, None]], seed=seed)


def _recent_table(run: Run) -> Array:
    """Return the score of each of the last evaluations' episodes, ``[C, E]``."""
    returns = [row["returns"] for row in run.evaluations[-NUM_RECENT:]]
    scores: Array = normalized_score(run.env, np.array(returns, dtype=np.float64))
    return scores


def _above(run: Run, thresholds: Array) -> Array:
    """Return how often each start state came above each score, ``[E, T]``."""
    above: Array = (_recent_table(run)[..., None] > thresholds).mean(0)
    return above
