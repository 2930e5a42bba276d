"""The way back: distance to the data after a disturbance, and the share recovered.

Distances are in units of the data's own 95 % quantile, as the files have them. An
episode recovers when it is within that quantile once more; who falls, or whose time is
over, has not. Shapes: ``T`` steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.evaluation import (
    NUM_RESAMPLES,
    nested_resamples,
    percentile_interval,
)
from torchrl_osr.report.robustness import decrease, suite_levels
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import Curve, Estimate, over_what

Array = NDArray[np.float64]


class Recovery(NamedTuple):
    """A method on a data set after one transient disturbance.

    Attributes:
        episodes: of all runs and checkpoints.
        reached: share in which the disturbance came; others had ended before.
        survived: of those, share that had not fallen when it ended.
        alive_after: of those, share that had not fallen at the end of the curves; not
            counted are the ones whose time was over before.
        median: steps until half of those had recovered; ``None`` if fewer did.
        undisturbed_alive: of their undisturbed partners, share that had not fallen
            at that step; ``None`` if nobody wrote it down.
        decrease: of the clean score, in percent, in those alone.
        recovered: share of those that had recovered, along the steps.
        distance: to the data along the steps, of the ones that still stood.
        undisturbed_distance: the same of their undisturbed partners, if written down.
    """

    episodes: int
    reached: float
    survived: float
    alive_after: float | None
    undisturbed_alive: float | None
    median: float | None
    decrease: Estimate | None
    recovered: Curve
    distance: Curve | None
    undisturbed_distance: Curve | None


def transient_levels(runs: Sequence[Run], suite: str) -> list[int]:
    """Return which levels of a suite end: those that one can recover from."""
    found = {
        index
        for run in runs
        for row in run.suites[suite]["evaluations"]
        for index, level in enumerate(row["levels"])
        if level.get("recovery_steps") is not None
    }
    return sorted(found)


def recovery(runs: Sequence[Run], suite: str, index: int) -> Recovery | None:
    """Return how the episodes of a method's runs on one data set came back.

    Args:
        runs: all with the suite.
        suite: its name.
        index: which level; a transient one.

    Returns:
        ``None`` if no episode reached the disturbance.
    """
    found = [_episodes(run, suite, index) for run in runs]
    episodes = sum(total for total, _ in found)
    tables = [reached for _, reached in found if len(reached)]
    if not tables:
        return None
    rows = np.concatenate(tables)
    median = float(np.median(rows[:, 4]))
    scores = [table[:, :2] for table in tables]
    return Recovery(
        episodes,
        len(rows) / episodes,
        float(rows[:, 2].mean()),
        _share_known(rows[:, 3]),
        _share_known(rows[:, 5]),
        median if np.isfinite(median) else None,
        decrease(
            np.mean([each.mean(0) for each in scores], axis=0),
            nested_resamples(scores),
            1,
            over_what([tables]),
        ),
        _recovered([table[:, 4] for table in tables], _horizon(runs, suite, index)),
        _distance(runs, suite, index, "mean", "count"),
        _distance(runs, suite, index, "clean_mean", "clean_count"),
    )


def _levels(run: Run, suite: str, index: int) -> list[tuple[Any, Any]]:
    """Return clean results and those of a level, of each checkpoint."""
    rows = run.suites[suite]["evaluations"]
    return [(row["clean"], row["levels"][index]) for row in rows]


def _episodes(run: Run, suite: str, index: int) -> tuple[int, Array]:
    """Return the number of episodes, and a row for each that reached the disturbance.

    Columns: clean score, score, survived, alive after, steps until recovery (infinite:
    not recovered), whether the undisturbed partner was alive. NaN: not known.
    """
    total, rows = 0, []
    for clean, level in _levels(run, suite, index):
        total += len(level["scores"])
        columns = zip(
            level["disturbed_at"],
            clean["scores"],
            level["scores"],
            level["survived_knock"],
            level["alive_after"],
            [np.inf if each is None else each for each in level["recovery_steps"]],
            level.get("clean_alive_after") or [None] * len(level["scores"]),
            strict=True,
        )
        rows += [row for at, *row in columns if at is not None]
    # What is None becomes NaN.
    return total, np.array(rows, dtype=np.float64).reshape(-1, 6)


def _share_known(values: Array) -> float | None:
    """Return the mean of what is known, ``None`` if nothing is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else None


def _horizon(runs: Sequence[Run], suite: str, index: int) -> int:
    """Return the last step of the distance curves."""
    level = _levels(runs[0], suite, index)[0][1]
    return int(max(level["distance"]["offset"]))


def _recovered(steps: Sequence[Array], horizon: int) -> Curve:
    """Return the share recovered until each step, every run with equal weight."""
    x = np.arange(horizon + 1, dtype=np.float64)
    within = [each[:, None] <= x for each in steps]
    mean = np.mean([each.mean(0) for each in within], axis=0)
    low, high = percentile_interval(nested_resamples(within))
    return Curve(x, mean, low, high, over_what([steps]))


def _distance(
    runs: Sequence[Run], suite: str, index: int, mean_key: str, count_key: str
) -> Curve | None:
    """Return the mean distance at each offset, with a band over seeds."""
    curves = []
    for run in runs:
        parts = [level["distance"] for _, level in _levels(run, suite, index)]
        if any(mean_key not in part for part in parts):
            return None
        count = np.array([part[count_key] for part in parts], dtype=np.float64)
        # What nobody was there to measure is null, and counts for nothing.
        mean = np.array([[v or 0.0 for v in part[mean_key]] for part in parts])
        total = count.sum(0)
        mean = np.divide((mean * count).sum(0), total, where=total > 0,
                         out=np.full(total.shape, np.nan))  # fmt: skip
        curves.append(mean)
    values = np.array(curves)
    offsets = np.array(parts[0]["offset"], dtype=np.float64)
    mean = _mean_of_known(values)
    if np.isnan(mean).all():
        return None
    if len(runs) == 1:
        return Curve(offsets, mean, mean, mean, "")
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(runs), size=(NUM_RESAMPLES, len(runs)))
    resamples = _mean_of_known(values[drawn].swapaxes(0, 1))
    resamples = np.where(np.isnan(resamples), mean, resamples)
    return Curve(offsets, mean, *percentile_interval(resamples), "seeds")


def _mean_of_known(values: Array) -> Array:
    """Return means over the first axis that leave out NaN, NaN where all are."""
    known = ~np.isnan(values)
    count = known.sum(0)
    total = np.where(known, values, 0.0).sum(0)
    mean: Array = np.divide(
        total, count, where=count > 0, out=np.full(total.shape, np.nan)
    )
    return mean


def level_title(runs: Sequence[Run], suite: str, index: int) -> str:
    """Return a level's name."""
    return suite_levels(runs, suite)[index].name
