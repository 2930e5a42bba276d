"""In what methods are compared, episode by episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from torchrl_osr.data import normalized_score
from torchrl_osr.evaluation import NUM_RECENT
from torchrl_osr.report.robustness import suite_levels, suites_of
from torchrl_osr.report.runs import Run

Episodes = dict[tuple[int, int], float]
"""A number of each episode, by checkpoint and episode seed."""


class Quantity(NamedTuple):
    """A number of an episode in which methods are compared.

    Attributes:
        name: in words.
        values: the numbers of a run's episodes; ``None`` if it has none.
        sign: 1 where more is better, -1 where less is.
        suite: which it is of, or "".
        level: which of its levels, or "" for their mean.
    """

    name: str
    values: Callable[[Run], Episodes | None]
    sign: int = 1
    suite: str = ""
    level: str = ""


def quantities(runs: Sequence[Run]) -> list[Quantity]:
    """Return all quantities that the runs have: the score, and two of each suite."""
    found = [Quantity("undisturbed score", _clean)]
    for suite in suites_of(runs):
        score, lost = partial(_suite, suite=suite), partial(_lost, suite=suite)
        found += [
            Quantity(f"score under {suite}", score, suite=suite),
            Quantity(f"points lost to {suite}", lost, sign=-1, suite=suite),
        ]
    return found


def level_quantities(runs: Sequence[Run], suite: str) -> list[Quantity]:
    """Return the score under each level of a suite."""
    return [
        Quantity(
            level.name, partial(_suite, suite=suite, level=index), 1, suite, level.name
        )
        for index, level in enumerate(suite_levels(runs, suite))
    ]


def _clean(run: Run) -> Episodes:
    """Return the scores of the last evaluations."""
    return {
        (row["step"], seed): normalized_score(run.env, float(value))
        for row in run.evaluations[-NUM_RECENT:]
        for seed, value in zip(row["seeds"], row["returns"], strict=True)
    }


def _suite(run: Run, suite: str, level: int | None = None) -> Episodes | None:
    """Return scores under a level, or their mean over all."""
    if suite not in run.suites:
        return None
    found = {}
    for row in run.suites[suite]["evaluations"]:
        scores = np.array([each["scores"] for each in row["levels"]], dtype=np.float64)
        values = scores.mean(0) if level is None else scores[level]
        for seed, value in zip(row["clean"]["seeds"], values, strict=True):
            found[row["step"], seed] = float(value)
    return found


def _lost(run: Run, suite: str) -> Episodes | None:
    """Return the clean score less the mean over all levels."""
    scores = _suite(run, suite)
    if scores is None:
        return None
    clean = {
        (row["step"], seed): value
        for row in run.suites[suite]["evaluations"]
        for seed, value in zip(
            row["clean"]["seeds"], row["clean"]["scores"], strict=True
        )
    }
    return {key: clean[key] - score for key, score in scores.items()}
