"""Scores of each method: undisturbed, over all data sets, disturbed, and the way back.

Everything is computed from the tables of :class:`~torchrl_osr.lab.report.RunTables`.
Shapes: ``E`` episodes, ``T`` places along an axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from torchrl_osr.lab.evaluation.statistics import (
    interquartile_mean,
    mean_interval,
    nested_resamples,
    percentile_interval,
    stratified_resamples,
)
from torchrl_osr.lab.evaluation.training_summary import NUM_RECENT

Array = NDArray[np.float64]


class Estimate(NamedTuple):
    """A mean with its 95 % interval.

    Attributes:
        mean: of the runs.
        low: lower end.
        high: upper end.
        over: what was resampled: "seeds"; "two seeds", whose interval is hardly more
            than the two of them; "episodes" or "walks" where a data set has one seed.
    """

    mean: float
    low: float
    high: float
    over: str = "seeds"

    def __str__(self) -> str:
        """Mean and interval, with a mark if that is not over seeds."""
        return f"{decimal(self.mean)} {self.interval()}"

    def interval(self, sign: str = "") -> str:
        """The interval in brackets, with a mark if it is not over seeds."""
        mark = {"seeds": "", "two seeds": " ²"}.get(self.over, " ᵉ")
        return f"[{decimal(self.low, sign)}, {decimal(self.high, sign)}]{mark}"


class Band(NamedTuple):
    """A number along an axis, with its 95 % band.

    Attributes:
        x: places, ``[T]``.
        mean: ``[T]``.
        low: lower end, ``[T]``; NaN where there is no band.
        high: upper end, ``[T]``.
    """

    x: Array
    mean: Array
    low: Array
    high: Array


class WayBack(NamedTuple):
    """A method on a data set after one disturbance that ends.

    Attributes:
        num_episodes: of all runs and checkpoints.
        reached: share in which the disturbance came; others had ended before.
        stood: of those, share that had not fallen when it ended.
        alive_after: of those, share that had not fallen at the end of the curves; not
            counted are the ones whose time was over before. NaN: not known.
        undisturbed_alive: the same of their undisturbed partners.
        median: steps until half of those had recovered; infinite if fewer did.
        decrease: of the clean score, in percent, in those alone.
        recovered: share of those that had recovered, along the steps.
        distance: to the data along the steps, of the ones that still stood.
    """

    num_episodes: int
    reached: float
    stood: float
    alive_after: float
    undisturbed_alive: float
    median: float
    decrease: Estimate | None
    recovered: Band
    distance: Band


def decimal(value: float, sign: str = "") -> str:
    """Number with one decimal; ``sign="+"`` shows that of positive ones, too."""
    # A minus sign, unlike a hyphen, stays with its number at the end of a line.
    return f"{value:{sign}z.1f}".replace("-", "\N{MINUS SIGN}")


def counted(number: int, noun: str) -> str:
    """A number of things: "1 run", "2 runs"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def over_what(groups: Sequence[Sequence[object]], alone: str = "episodes") -> str:
    """What an interval is over, given the runs of each data set; ``alone`` with one."""
    fewest = min(map(len, groups))
    return {1: alone, 2: "two seeds"}.get(fewest, "seeds")


def undisturbed(episodes: pd.DataFrame) -> pd.DataFrame:
    """The episodes of the training's own evaluations."""
    return episodes[episodes["suite"] == ""]


def recent(episodes: pd.DataFrame, number: int = NUM_RECENT) -> pd.DataFrame:
    """The undisturbed episodes of each run's last evaluations, by default five."""
    found = undisturbed(episodes)
    rank = found.groupby("run")["step"].rank("dense", ascending=False)
    return found[rank <= number]


def by_run(episodes: pd.DataFrame) -> list[Array]:
    """Scores of each run's start states, ``[E]`` each.

    Evaluations that start in the same state are averaged: they are no new episodes.
    """
    means = episodes.groupby(["run", "episode"], sort=False)["score"].mean()
    return [run.to_numpy() for _, run in means.groupby("run", sort=False)]


def estimate(runs: Sequence[Array]) -> Estimate:
    """Mean over runs and its interval.

    Args:
        runs: scores of each run's episodes, ``[E]``.

    Returns:
        Interval over the runs' means; with one run, over its episodes.
    """
    over = over_what([runs])
    if over == "episodes":
        return Estimate(*mean_interval(runs[0]), over)
    return Estimate(*mean_interval([run.mean() for run in runs]), over)


def score_curve(episodes: pd.DataFrame) -> Band:
    """A method's undisturbed score on one data set, with a band over seeds."""
    rows = undisturbed(episodes).groupby("step")
    found = np.array([estimate(by_run(each))[:3] for _, each in rows])
    if episodes["run"].nunique() == 1:
        found[:, 1:] = np.nan
    return Band(np.array(list(rows.groups), dtype=np.float64), *found.T)


def iqm(episodes: pd.DataFrame) -> Estimate:
    """Interquartile mean of a method's runs, over data sets and seeds.

    Runs are resampled within their data sets. Where one of these has no second seed
    that is impossible, and the interval is over the runs' episodes instead.
    """
    groups = _strata(episodes)
    scores = [[run.mean() for run in group] for group in groups]
    over = over_what(groups)
    if over != "episodes":
        resamples = stratified_resamples(scores)
    else:
        runs = [run for group in groups for run in group]
        resamples = np.concatenate(
            [nested_resamples([run[:, None]], seed=n) for n, run in enumerate(runs)],
            axis=1,
        )
    point = float(interquartile_mean(np.concatenate(scores)))
    return _estimate(point, interquartile_mean(resamples), over)


def profile(episodes: pd.DataFrame, thresholds: Array) -> Band:
    """Share of a method's runs above each threshold, with a band over seeds."""
    scores = [[run.mean() for run in group] for group in _strata(episodes)]
    mean = performance_profile(np.concatenate(scores), thresholds)
    resamples = performance_profile(stratified_resamples(scores), thresholds)
    if over_what(scores) == "episodes":
        resamples[:] = np.nan
    return Band(thresholds, mean, *percentile_interval(resamples))


def disturbed(rows: pd.DataFrame) -> dict[str, tuple[Estimate, Estimate | None]]:
    """Scores of a method's runs on one data set under a suite.

    Intervals resample seeds, then episodes in pairs.

    Args:
        rows: episodes of the method on the data set under the suite.

    Returns:
        By disturbance, the undisturbed ``""`` first: the score, and its decrease in
        percent of the undisturbed one, see :func:`decrease`.
    """
    names = list(rows["disturbance"].unique())
    runs = [
        run.pivot_table(values="score", index="episode", columns="disturbance")[names]
        for _, run in rows.groupby("run", sort=False)
    ]
    resamples = pd.DataFrame(nested_resamples(runs), columns=names)
    means = pd.DataFrame([run.mean() for run in runs]).mean()
    over = over_what([runs])
    return {
        name: (
            _estimate(means[name], resamples[name], over),
            decrease(means, resamples, name, over),
        )
        for name in names
    }


def decrease(
    means: pd.Series, resamples: pd.DataFrame, name: str, over: str
) -> Estimate | None:
    """Percent by which a score is below the clean one.

    Args:
        means: by disturbance, ``""`` is none.
        resamples: the same of each resample.
        name: of the disturbance.
        over: what was resampled.

    Returns:
        ``None`` if the clean score is not above 0 in some resample: then there is
        nothing to take a percentage of.
    """
    if means[""] <= 0 or (resamples[""] <= 0).any():
        return None
    lost = 100 * (1 - resamples[name] / resamples[""])
    return _estimate(100 * (1 - means[name] / means[""]), lost, over)


def way_back(
    rows: pd.DataFrame, curves: pd.DataFrame, disturbance: str
) -> WayBack | None:
    """How the episodes of a method's runs on one data set came back.

    Distances are in units of the data's own 95 % quantile, as the files have them. An
    episode recovers when it is within that quantile once more; who falls, or whose time
    is over, has not.

    Args:
        rows: episodes of the method on the data set under the suite.
        curves: distances of the same under the disturbance.
        disturbance: its name; one that ends.

    Returns:
        ``None`` if no episode reached the disturbance.
    """
    partner = ["run", "step", "episode"]
    clean = rows[rows["disturbance"] == ""].set_index(partner)["score"].rename("")
    rows = rows[rows["disturbance"] == disturbance].join(clean, on=partner)
    there = rows[rows["disturbed_at"].notna()]
    if there.empty:
        return None
    runs = [run for _, run in there.groupby("run", sort=False)]
    over = over_what([runs])
    pairs = [run[["", "score"]] for run in runs]
    means = pd.DataFrame([each.mean() for each in pairs]).mean()
    resamples = pd.DataFrame(nested_resamples(pairs), columns=["", "score"])
    steps = np.sort(curves["offset"][curves["offset"] >= 0].unique()).astype(float)
    within = [run["recovery_steps"].to_numpy()[:, None] <= steps for run in runs]
    recovered = np.mean([each.mean(0) for each in within], axis=0)
    columns = ["stood", "alive_after", "undisturbed_alive"]
    shares = there.groupby("run")[columns].mean().mean()  # as all else: a run, a vote
    return WayBack(
        num_episodes=len(rows),
        reached=len(there) / len(rows),
        **shares,
        median=float(there["recovery_steps"].fillna(np.inf).median()),
        decrease=decrease(means, resamples, "score", over),
        recovered=Band(
            steps, recovered, *percentile_interval(nested_resamples(within))
        ),
        distance=mean_distance(curves),
    )


def mean_distance(curves: pd.DataFrame) -> Band:
    """Mean distance to the data at each offset, with a band over seeds.

    There is no band with one seed, or where a seed has no episode left.
    """
    # What nobody was there to measure is NaN, and counts for nothing.
    known = curves.assign(total=curves["mean"].fillna(0.0) * curves["count"])
    sums = known.groupby(["run", "offset"])[["total", "count"]].sum()
    runs = (sums["total"] / sums["count"].where(sums["count"] > 0)).unstack("offset")
    resamples = nested_resamples([run.to_numpy()[None] for _, run in runs.iterrows()])
    if len(runs) == 1:
        resamples[:] = np.nan
    x = runs.columns.to_numpy(dtype=np.float64)
    return Band(x, runs.mean().to_numpy(), *percentile_interval(resamples))


def performance_profile(values: Array, thresholds: Array) -> Array:
    """Share of values above each threshold, over the last axis."""
    return np.stack([(values > each).mean(-1) for each in thresholds], axis=-1)


def _strata(episodes: pd.DataFrame) -> list[list[Array]]:
    """Recent scores of a method's runs, data set by data set."""
    groups = recent(episodes).groupby("data", sort=False)
    return [by_run(group) for _, group in groups]


def _estimate(point: float, resamples: pd.Series | Array, over: str) -> Estimate:
    low, high = percentile_interval(np.asarray(resamples))
    return Estimate(float(point), float(low), float(high), over)
