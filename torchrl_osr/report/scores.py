"""Scores of each method: undisturbed, over all data sets, disturbed, and the way back.

Everything is computed from the tables of :class:`~torchrl_osr.report.runs.RunTables`.
Shapes: ``E`` episodes, ``L`` disturbances, ``R`` resamples, ``T`` places along an axis.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from torchrl_osr.evaluation import (
    NUM_RECENT,
    NUM_RESAMPLES,
    interquartile_mean,
    mean_interval,
    nested_resamples,
    percentile_interval,
    performance_profile,
    stratified_resamples,
)

Array = NDArray[np.float64]

SIZES = r"\d[\d.e+-]*|xs|s|m|l|xl|slight|small|medium|moderate|large"
"""What behind the last hyphen of a disturbance's name is its size, not its kind."""


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
        return f"{decimal(self.mean)} {self.interval()}"

    def interval(self, sign: str = "") -> str:
        """Return ``"[low, high]"``, with a mark if not over seeds."""
        mark = "" if self.over == "seeds" else " ᵉ"
        return f"[{decimal(self.low, sign)}, {decimal(self.high, sign)}]{mark}"


class Band(NamedTuple):
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
    over: str = ""


class Disturbed(NamedTuple):
    """A method on a data set under one suite.

    Attributes:
        seeds: number of runs.
        clean: score without a disturbance.
        scores: score under each disturbance.
        decreases: of the clean score, in percent; ``None`` where that is not above 0.
        shares: of the clean score under each disturbance, of each resample, ``[R, L]``;
            ``None`` where the clean score is not above 0.
    """

    seeds: int
    clean: Estimate
    scores: Mapping[str, Estimate]
    decreases: Mapping[str, Estimate | None]
    shares: pd.DataFrame | None


class WayBack(NamedTuple):
    """A method on a data set after one disturbance that ends.

    Attributes:
        episodes: of all runs and checkpoints.
        reached: share in which the disturbance came; others had ended before.
        stood: of those, share that had not fallen when it ended.
        alive_after: of those, share that had not fallen at the end of the curves; not
            counted are the ones whose time was over before. ``None``: not known.
        undisturbed_alive: the same of their undisturbed partners.
        median: steps until half of those had recovered; ``None`` if fewer did.
        decrease: of the clean score, in percent, in those alone.
        recovered: share of those that had recovered, along the steps.
        distance: to the data along the steps, of the ones that still stood.
        undisturbed_distance: of their undisturbed partners.
    """

    episodes: int
    reached: float
    stood: float
    alive_after: float | None
    undisturbed_alive: float | None
    median: float | None
    decrease: Estimate | None
    recovered: Band
    distance: Band | None
    undisturbed_distance: Band | None


def decimal(value: float, sign: str = "") -> str:
    """Return a number with one decimal, and a minus that no line breaks behind.

    Args:
        value: the number.
        sign: ``"+"`` shows that of positive numbers, too.
    """
    return f"{value:{sign}.1f}".replace("-", "\N{MINUS SIGN}")


def over_what(groups: Sequence[Sequence[object]]) -> str:
    """Return what an interval is over: seeds, if each data set has several.

    Args:
        groups: something of each seed, data set by data set.
    """
    return "seeds" if min(map(len, groups)) > 1 else "episodes"


def undisturbed(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the episodes of the training's own evaluations."""
    return episodes[episodes["suite"] == ""]


def recent(episodes: pd.DataFrame, number: int = NUM_RECENT) -> pd.DataFrame:
    """Return the undisturbed episodes of each run's last evaluations.

    Args:
        episodes: of runs.
        number: of evaluations. Default: :data:`NUM_RECENT`.
    """
    found = undisturbed(episodes)
    rank = found.groupby("run")["step"].rank("dense", ascending=False)
    return found[rank <= number]


def by_run(episodes: pd.DataFrame) -> list[Array]:
    """Return the scores of each run's start states, ``[E]`` each.

    Evaluations that start in the same state are averaged: they are no new episodes.
    """
    means = episodes.groupby(["run", "episode"], sort=False)["score"].mean()
    return [run.to_numpy() for _, run in means.groupby("run", sort=False)]


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


def score_curve(episodes: pd.DataFrame) -> Band:
    """Return a method's undisturbed score along the steps, with a band over seeds.

    Args:
        episodes: of the method's runs on one data set.
    """
    rows = undisturbed(episodes).groupby("step")
    found = [estimate(by_run(each)) for _, each in rows]
    mean, low, high = (np.array([each[end] for each in found]) for end in range(3))
    over = "seeds" if episodes["run"].nunique() > 1 else ""
    return Band(np.array(list(rows.groups), dtype=np.float64), mean, low, high, over)


def strata(episodes: pd.DataFrame) -> list[list[Array]]:
    """Return the recent scores of a method's runs, data set by data set."""
    groups = recent(episodes).groupby("data", sort=False)
    return [by_run(group) for _, group in groups]


def iqm(episodes: pd.DataFrame) -> Estimate:
    """Return the interquartile mean of a method's runs, over data sets and seeds.

    Runs are resampled within their data sets. Where one of these has no second seed
    that is impossible, and the interval is over the runs' episodes instead.

    Args:
        episodes: of the method.
    """
    groups = strata(episodes)
    scores = [[run.mean() for run in group] for group in groups]
    point = float(interquartile_mean(np.concatenate(scores)))
    over = over_what(groups)
    if over == "seeds":
        resamples = stratified_resamples(scores)
    else:
        runs = [run for group in groups for run in group]
        resamples = np.concatenate(
            [nested_resamples([run[:, None]], seed=n) for n, run in enumerate(runs)],
            axis=1,
        )
    low, high = percentile_interval(interquartile_mean(resamples))
    return Estimate(point, float(low), float(high), over)


def thresholds_of(episodes: pd.DataFrame, number: int = 121) -> Array:
    """Return thresholds from 0, or the lowest score of an episode, to the highest."""
    scores = recent(episodes)["score"]
    return np.linspace(min(0.0, scores.min()), scores.max(), number)


def run_profile(episodes: pd.DataFrame, thresholds: Array) -> Band:
    """Return the share of a method's runs above each score."""
    scores = [[run.mean() for run in group] for group in strata(episodes)]
    mean = performance_profile(np.concatenate(scores), thresholds)
    if over_what(scores) != "seeds":
        return Band(thresholds, mean, mean, mean)
    resamples = performance_profile(stratified_resamples(scores), thresholds)
    return Band(thresholds, mean, *percentile_interval(resamples), "seeds")


def episode_profile(episodes: pd.DataFrame, thresholds: Array) -> Band:
    """Return the share of a method's episodes above each score.

    Every data set counts the same; within it seeds are resampled, then episodes.
    """
    tables = [
        [
            # How often each start state came above each score, [E, T].
            performance_profile(_table(run, "step"), thresholds)
            for _, run in group.groupby("run", sort=False)
        ]
        for _, group in recent(episodes).groupby("data", sort=False)
    ]
    means = [np.mean([run.mean(0) for run in group], axis=0) for group in tables]
    mean = np.mean(means, axis=0)
    # A seed for each data set: with one, they would be drawn alike.
    resamples = [nested_resamples(each, seed=seed) for seed, each in enumerate(tables)]
    low, high = percentile_interval(np.mean(resamples, axis=0))
    return Band(thresholds, mean, low, high, over_what(tables))


def disturbances(episodes: pd.DataFrame, suite: str) -> pd.DataFrame:
    """Return a suite's disturbances, those of one series by growing strength.

    Returns:
        ``kind``, ``strength``, ``series`` and ``transient`` by ``disturbance``.
    """
    rows = episodes[(episodes["suite"] == suite) & (episodes["disturbance"] != "")]
    columns = ["disturbance", "kind", "strength", "transient"]
    found = rows[columns].drop_duplicates("disturbance").set_index("disturbance")
    found["series"] = [series_name(name, row["kind"]) for name, row in found.iterrows()]
    order = {name: place for place, name in enumerate(found["series"].unique())}
    found["order"] = found["series"].map(order)
    return found.sort_values(["order", "strength"], kind="stable").drop(columns="order")


def series_name(name: str, kind: str) -> str:
    """Return what a disturbance is a strength of.

    Examples:
        >>> series_name("torque-20", "knock")
        'knock: torque'
    """
    stem = re.sub(rf"-({SIZES})$", "", name)
    of_stem, of_kind = (set(re.split(r"[\s-]", each)) for each in (stem, kind))
    if of_kind <= of_stem:
        return stem
    return kind if of_stem <= of_kind else f"{kind}: {stem}"


def disturbed(episodes: pd.DataFrame, suite: str) -> Disturbed:
    """Return what a method's runs on one data set score under a suite.

    Intervals resample seeds, then episodes in pairs.

    Args:
        episodes: of the method on the data set.
        suite: its name.
    """
    rows = episodes[episodes["suite"] == suite]
    names = ["", *disturbances(rows, suite).index]
    runs = [
        _table(run, "disturbance")[names] for _, run in rows.groupby("run", sort=False)
    ]
    resamples = pd.DataFrame(nested_resamples(runs), columns=names)
    means = pd.DataFrame([run.mean() for run in runs]).mean()
    over = over_what([runs])
    clean, *scores = [_estimate(means[name], resamples[name], over) for name in names]
    positive = means[""] > 0 and (resamples[""] > 0).all()
    shares = 100 * resamples.div(resamples[""], axis=0) if positive else None
    decreases = {name: decrease(means, resamples, name, over) for name in names[1:]}
    return Disturbed(
        len(runs), clean, dict(zip(names[1:], scores, strict=True)), decreases, shares
    )


def decrease(
    means: pd.Series, resamples: pd.DataFrame, name: str, over: str
) -> Estimate | None:
    """Return by how many percent a score is below the clean one.

    Args:
        means: by disturbance, ``""`` is none.
        resamples: the same of each resample, ``[R]``.
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


def area(found: Disturbed, strengths: pd.Series) -> Estimate | None:
    """Return the mean share of the clean score over the strengths, in percent.

    That is the area under the curve by the trapezoid rule, over the range of strengths.

    Args:
        found: of a method.
        strengths: growing, by disturbance.

    Returns:
        ``None`` with fewer than two strengths, or without a clean score above 0.
    """
    if strengths.nunique() < 2 or found.shares is None:
        return None
    points = [
        100 * found.scores[name].mean / found.clean.mean for name in strengths.index
    ]
    # Each strength's share of the range: half the way to its neighbours.
    steps = np.diff(strengths) / (strengths.iloc[-1] - strengths.iloc[0])
    weights = (np.append(steps, 0) + np.append(0, steps)) / 2
    shares = found.shares[strengths.index].to_numpy() @ weights
    return _estimate(np.array(points) @ weights, shares, found.clean.over)


def way_back(
    episodes: pd.DataFrame, distances: pd.DataFrame, suite: str, disturbance: str
) -> WayBack | None:
    """Return how the episodes of a method's runs on one data set came back.

    Distances are in units of the data's own 95 % quantile, as the files have them. An
    episode recovers when it is within that quantile once more; who falls, or whose time
    is over, has not.

    Args:
        episodes: of the method on the data set.
        distances: of the same.
        suite: its name.
        disturbance: its name; one that ends.

    Returns:
        ``None`` if no episode reached the disturbance.
    """
    rows = episodes[episodes["suite"] == suite]
    partner = ["run", "step", "episode"]
    clean = rows[rows["disturbance"] == ""].set_index(partner)["score"].rename("clean")
    rows = rows[rows["disturbance"] == disturbance].join(clean, on=partner)
    there = rows[rows["reached"]]
    if there.empty:
        return None
    of_level = (distances["suite"] == suite) & (distances["disturbance"] == disturbance)
    curves = distances[of_level]
    runs = [run for _, run in there.groupby("run", sort=False)]
    over = over_what([runs])
    pairs = [run[["clean", "score"]] for run in runs]
    means = pd.DataFrame([each.mean() for each in pairs]).mean()
    resamples = pd.DataFrame(nested_resamples(pairs), columns=["", disturbance])
    median = float(there["recovery_steps"].median())
    x = np.arange(curves["offset"].max() + 1, dtype=np.float64)
    within = [run["recovery_steps"].to_numpy()[:, None] <= x for run in runs]
    recovered = np.mean([each.mean(0) for each in within], axis=0)
    ends = percentile_interval(nested_resamples(within))
    return WayBack(
        episodes=len(rows),
        reached=len(there) / len(rows),
        stood=float(there["stood"].mean()),
        alive_after=_known(there["alive_after"]),
        undisturbed_alive=_known(there["undisturbed_alive"]),
        median=median if np.isfinite(median) else None,
        decrease=decrease(
            means.set_axis(["", disturbance]), resamples, disturbance, over
        ),
        recovered=Band(x, recovered, *ends, over),
        distance=mean_distance(curves, "distance", "count"),
        undisturbed_distance=mean_distance(
            curves, "undisturbed_distance", "undisturbed_count"
        ),
    )


def mean_distance(curves: pd.DataFrame, distance: str, count: str) -> Band | None:
    """Return the mean distance at each offset, with a band over seeds.

    Args:
        curves: of a method's runs on one data set, after one disturbance.
        distance: column of the mean distance of a checkpoint's episodes.
        count: column of how many episodes these are.
    """
    # What nobody was there to measure is NaN, and counts for nothing.
    known = curves.assign(total=curves[distance].fillna(0.0) * curves[count])
    sums = known.groupby(["run", "offset"])[["total", count]].sum()
    runs = (sums["total"] / sums[count].where(sums[count] > 0)).unstack("offset")
    mean = runs.mean().to_numpy()
    offsets = runs.columns.to_numpy(dtype=np.float64)
    if np.isnan(mean).all():
        return None
    if len(runs) == 1:
        return Band(offsets, mean, mean, mean)
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(runs), size=(NUM_RESAMPLES, len(runs)))
    values = np.ma.masked_invalid(runs.to_numpy()[drawn])  # [R, runs, T]
    resamples = np.ma.filled(values.mean(1), np.nan)
    resamples = np.where(np.isnan(resamples), mean, resamples)
    return Band(offsets, mean, *percentile_interval(resamples), "seeds")


def _table(rows: pd.DataFrame, columns: str) -> pd.DataFrame:
    """Return a run's mean scores with a row a start state, ``[E, columns]``."""
    return rows.pivot_table(values="score", index="episode", columns=columns)


def _estimate(point: float, resamples: pd.Series | Array, over: str) -> Estimate:
    low, high = percentile_interval(np.asarray(resamples))
    return Estimate(float(point), float(low), float(high), over)


def _known(values: pd.Series) -> float | None:
    """Return the mean of what is known, ``None`` if nothing is."""
    return None if values.isna().all() else float(values.mean())
