"""Scores under disturbances: what is lost, and at which strength.

Robustness files hold clean and disturbed episodes in pairs. Shapes: ``E`` start
states, ``L`` levels, ``R`` resamples.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.evaluation import nested_resamples, percentile_interval
from torchrl_osr.report.files import levels_of
from torchrl_osr.report.methods import distinctions
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import Estimate, over_what

Array = NDArray[np.float64]

SIZES = r"\d[\d.e+-]*|xs|s|m|l|xl|slight|small|medium|moderate|large"
"""What behind the last hyphen of a level's name is its size, not its kind."""


class Level(NamedTuple):
    """One disturbance at one strength.

    Attributes:
        name: unique in its suite.
        kind: what is disturbed.
        strength: in the unit of its kind.
    """

    name: str
    kind: str
    strength: float

    @property
    def series(self) -> str:
        """What it is a strength of: ``"knock: torque"`` for ``torque-20``."""
        stem = re.sub(rf"-({SIZES})$", "", self.name)
        of_stem, of_kind = (set(re.split(r"[\s-]", each)) for each in (stem, self.kind))
        if of_kind <= of_stem:
            return stem
        return self.kind if of_stem <= of_kind else f"{self.kind}: {stem}"


class Disturbed(NamedTuple):
    """A method on a data set under one suite.

    Attributes:
        levels: ``L`` disturbances.
        clean: score without one.
        scores: score under each.
        decreases: of the clean score, in percent; ``None`` where that is not above 0.
        resamples: bootstrap means, clean first, ``[R, 1 + L]``.
        seeds: how many runs.
    """

    levels: list[Level]
    clean: Estimate
    scores: list[Estimate]
    decreases: list[Estimate | None]
    resamples: Array
    seeds: int


def name_suites(runs: Sequence[Run]) -> list[Run]:
    """Give suites of one name that were played differently different names."""
    places: dict[str, list[int]] = defaultdict(list)
    for index, run in enumerate(runs):
        for suite in run.suites:
            places[suite].append(index)
    renamed: list[dict[str, Any]] = [{} for _ in runs]
    for suite, indices in places.items():
        texts = distinctions([protocol(runs[i], suite) for i in indices])
        for index, text in zip(indices, texts, strict=True):
            name = f"{suite} ({text})" if text else suite
            renamed[index][name] = runs[index].suites[suite]
    return [
        replace(run, suites=suites) for run, suites in zip(runs, renamed, strict=True)
    ]


def protocol(run: Run, suite: str) -> Mapping[str, Any]:
    """Return what must be equal for two results of a suite to be compared."""
    evaluations = run.suites[suite]["evaluations"]
    seeds = [row["clean"]["seeds"] for row in evaluations]
    steps = [row["step"] for row in evaluations]
    trained = [row["step"] for row in run.evaluations]
    last = steps == trained[-len(steps) :]
    return {
        "checkpoints": f"last {len(steps)}" if last else steps,
        "episodes": sum(map(len, seeds)),
        "episode seeds": seeds,
        "levels": levels_of(evaluations[0]),
    }


def suites_of(runs: Sequence[Run]) -> list[str]:
    """Return the suites, in the order in which they are met."""
    return list(dict.fromkeys(suite for run in runs for suite in run.suites))


def with_suite(runs: Sequence[Run], suite: str) -> list[Run]:
    """Return the runs that have results of a suite."""
    return [run for run in runs if suite in run.suites]


def suite_levels(runs: Sequence[Run], suite: str) -> list[Level]:
    """Return a suite's disturbances."""
    evaluation = with_suite(runs, suite)[0].suites[suite]["evaluations"][0]
    return [Level(*level) for level in levels_of(evaluation)]


def episode_table(run: Run, suite: str) -> Array:
    """Return the scores of each start state, clean first, ``[E, 1 + L]``.

    Checkpoints that start in the same state are averaged: they are no new episodes.
    """
    rows: dict[int, list[Array]] = defaultdict(list)
    for evaluation in run.suites[suite]["evaluations"]:
        parts = [
            part["scores"] for part in (evaluation["clean"], *evaluation["levels"])
        ]
        scores = np.array(parts, dtype=np.float64).T
        for seed, row in zip(evaluation["clean"]["seeds"], scores, strict=True):
            rows[seed].append(row)
    return np.array([np.mean(each, axis=0) for each in rows.values()])


def disturbed(runs: Sequence[Run], suite: str) -> Disturbed:
    """Return what a method's runs on one data set score under a suite.

    Intervals resample seeds, then episodes in pairs.

    Args:
        runs: of one method and data set, all with the suite.
        suite: its name.
    """
    tables = [episode_table(run, suite) for run in runs]
    resamples = nested_resamples(tables)
    means = np.mean([table.mean(0) for table in tables], axis=0)
    low, high = percentile_interval(resamples)
    over = over_what([runs])
    clean, *scores = [
        Estimate(float(means[i]), float(low[i]), float(high[i]), over)
        for i in range(len(means))
    ]
    levels = suite_levels(runs, suite)
    return Disturbed(
        levels,
        clean,
        scores,
        [decrease(means, resamples, 1 + i, over) for i in range(len(levels))],
        resamples,
        len(runs),
    )


def decrease(means: Array, resamples: Array, column: int, over: str) -> Estimate | None:
    """Return by how many percent a column is below the first.

    Args:
        means: clean first, ``[1 + L]``.
        resamples: the same of each resample, ``[R, 1 + L]``.
        column: which level.
        over: what was resampled.

    Returns:
        ``None`` if the clean score is not above 0 in some resample: then there is
        nothing to take a percentage of.
    """
    if means[0] <= 0 or resamples[:, 0].min() <= 0:
        return None
    low, high = percentile_interval(100 * (1 - resamples[:, column] / resamples[:, 0]))
    point = 100 * (1 - means[column] / means[0])
    return Estimate(float(point), float(low), float(high), over)


def series_of(levels: Sequence[Level]) -> dict[str, list[int]]:
    """Return the levels of each kind of disturbance, by growing strength."""
    found: dict[str, list[int]] = defaultdict(list)
    for index, level in enumerate(levels):
        found[level.series].append(index)
    return {
        name: sorted(each, key=lambda i: (levels[i].strength, levels[i].name))
        for name, each in found.items()
    }


def area(result: Disturbed, indices: Sequence[int]) -> Estimate | None:
    """Return the mean share of the clean score over the strengths, in percent.

    That is the area under the curve by the trapezoid rule, over the range of strengths.

    Returns:
        ``None`` with fewer than two strengths, or without a clean score above 0.
    """
    strengths = np.array([result.levels[i].strength for i in indices])
    if len(set(strengths)) < 2 or result.decreases[indices[0]] is None:
        return None
    columns = [1 + i for i in indices]
    shares = 100 * result.resamples[:, columns] / result.resamples[:, :1]
    points = np.array([100 * result.scores[i].mean for i in indices])
    # Each strength's share of the range: half the way to its neighbours.
    steps = np.diff(strengths) / (strengths[-1] - strengths[0])
    weights = (np.append(steps, 0) + np.append(0, steps)) / 2
    low, high = percentile_interval(shares @ weights)
    point = float(points @ weights / result.clean.mean)
    return Estimate(point, float(low), float(high), result.clean.over)
