"""Is one method better than another? Differences of the same episodes, and a verdict.

Two runs are compared if they have the same data set and seed, and episode by episode
if these have the same checkpoint and start state. Intervals resample seeds, then
episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from torchrl_osr.evaluation import nested_resamples, percentile_interval
from torchrl_osr.report.methods import METHOD, comparable, exact
from torchrl_osr.report.runs import Run, RunTables
from torchrl_osr.report.scores import (
    Estimate,
    decimal,
    disturbances,
    over_what,
    recent,
)

Array = NDArray[np.float64]

ALL_DATA = "all data sets"

MIN_SEEDS = 5
"""Pairs of runs on each data set below which there is no verdict.

A bootstrap over three seeds holds the true mean in about 76 of 100 cases, over five in
83, over ten in 89: with fewer, an interval without 0 says next to nothing.
"""

PAIR = ["step", "episode"]


class Quantity(NamedTuple):
    """A number of an episode in which methods are compared.

    Attributes:
        name: in words.
        values: by ``data``, ``method``, ``seed``, ``step`` and ``episode``.
        sign: 1 where more is better, -1 where less is.
    """

    name: str
    values: pd.Series
    sign: int = 1


class Difference(NamedTuple):
    """A method less the reference, in one quantity on one data set or all.

    Attributes:
        data: a data set, or :data:`ALL_DATA`.
        method: which is compared.
        quantity: in what.
        estimate: method less reference; ``None`` if they cannot be paired.
        seeds: pairs of runs, the fewest that a data set has.
        note: why they cannot, or what else differs between them.
    """

    data: str
    method: str
    quantity: Quantity
    estimate: Estimate | None
    seeds: int
    note: str = ""

    @property
    def verdict(self) -> str:
        """Return "better", "worse", "not told apart" or why there is no verdict."""
        if self.estimate is None:
            return "not paired"
        if self.seeds < MIN_SEEDS:
            return f"cannot be told: {self.seeds} seed{'s' if self.seeds > 1 else ''}"
        if self.estimate.low <= 0 <= self.estimate.high:
            return "not told apart"
        return "better" if self.estimate.mean * self.quantity.sign > 0 else "worse"

    @property
    def told(self) -> bool:
        """Whether one of the two is better."""
        return self.verdict in ("better", "worse")


def quantities(tables: RunTables) -> list[Quantity]:
    """Return what methods are compared in: the score, and two numbers of each suite."""
    found = [Quantity("undisturbed score", _values(recent(tables.episodes)))]
    for suite in tables.suites:
        rows = tables.episodes[tables.episodes["suite"] == suite]
        none = rows["disturbance"] == ""
        clean, under = _values(rows[none]), _values(rows[~none])
        found += [
            Quantity(f"score under {suite}", under),
            Quantity(f"points lost to {suite}", clean - under, sign=-1),
        ]
    return found


def suite_quantities(tables: RunTables, suite: str) -> list[Quantity]:
    """Return the score under each disturbance of a suite."""
    rows = tables.episodes[tables.episodes["suite"] == suite]
    return [
        Quantity(name, _values(rows[rows["disturbance"] == name]))
        for name in disturbances(rows, suite).index
    ]


def compare(
    tables: RunTables, method: str, reference: str, quantity: Quantity
) -> list[Difference]:
    """Compare a method with the reference on each data set, and on all together.

    Args:
        tables: all of the report.
        method: its name.
        reference: the other's name.
        quantity: in what.

    Returns:
        Data set by data set, then :data:`ALL_DATA` if there are several. Data sets
        where one of the two has no such numbers are left out.
    """
    found, paired = [], []
    cells = tables.cells()
    for data in tables.data:
        own, other = (
            {run.seed: run for run in cells.get((data, name), ())
             if (data, name, run.seed) in quantity.values}
            for name in (method, reference)
        )  # fmt: skip
        if not own or not other:
            continue
        seeds = sorted(own.keys() & other.keys())
        try:
            pairs = [
                pair(
                    quantity.values[data, method, seed],
                    quantity.values[data, reference, seed],
                )
                for seed in seeds
            ]
            if not pairs:
                raise ValueError("they have no seed in common")
        except ValueError as error:
            found.append(Difference(data, method, quantity, None, 0, str(error)))
            continue
        notes = [_caveat([(own[seed], other[seed]) for seed in seeds])]
        if len(seeds) < len(own.keys() | other.keys()):
            notes.append("only seeds that both have")
        note = "; ".join(filter(None, notes))
        estimate = mean_difference([pairs])
        found.append(Difference(data, method, quantity, estimate, len(pairs), note))
        paired.append(pairs)
    if len(paired) > 1:
        notes = [each.note for each in found if each.estimate is not None]
        if len(paired) < len(tables.data):
            notes.insert(0, f"of {len(paired)} data sets")
        together = mean_difference(paired)
        note = "; ".join(dict.fromkeys(filter(None, notes)))
        fewest = min(map(len, paired))
        found.append(Difference(ALL_DATA, method, quantity, together, fewest, note))
    return found


def compare_all(
    tables: RunTables, reference: str, wanted: Sequence[Quantity]
) -> list[Difference]:
    """Compare every method with the reference."""
    return [
        each
        for method in tables.methods
        if method != reference
        for quantity in wanted
        for each in compare(tables, method, reference, quantity)
    ]


def pair(own: pd.Series, reference: pd.Series) -> Array:
    """Return the differences of two runs' episodes, averaged over checkpoints, ``[E]``.

    Args:
        own: numbers by step and episode.
        reference: the same of the other run.

    Raises:
        ValueError: if an episode of one is not there in the other.
    """
    alone = own.index.symmetric_difference(reference.index)
    if len(alone):
        step, episode = alone[0]
        raise ValueError(
            f"{len(alone)} episodes have no partner, the first at step {step:,} with "
            f"episode seed {episode}"
        )
    differences: Array = (own - reference).groupby("episode").mean().to_numpy()
    return differences


def mean_difference(data_sets: Sequence[Sequence[Array]]) -> Estimate:
    """Return the mean difference, every data set and every seed with equal weight.

    Args:
        data_sets: differences of each seed's episodes, ``[E]``, data set by data set.
    """
    point = np.mean([np.mean([run.mean() for run in each]) for each in data_sets])
    # A seed for each data set: with one, they would be drawn alike.
    resamples = [
        nested_resamples([run[:, None] for run in each], seed=index)
        for index, each in enumerate(data_sets)
    ]
    low, high = percentile_interval(np.mean(resamples, axis=0).ravel())
    return Estimate(float(point), float(low), float(high), over_what(data_sets))


def _values(rows: pd.DataFrame) -> pd.Series:
    """Return the mean score of each episode over the disturbances in the rows."""
    return rows.groupby(["data", "method", "seed", *PAIR])["score"].mean()


def _caveat(pairs: Sequence[tuple[Run, Run]]) -> str:
    """Return in which settings the partners differ, beside their methods."""
    keys = set()
    for own, other in pairs:
        mine, theirs = comparable(own), comparable(other)
        keys |= {
            key
            for key in mine.keys() | theirs.keys()
            if not key.startswith(METHOD) and exact(key, mine) != exact(key, theirs)
        }
        if own.versions != other.versions:
            keys.add("versions")
    return f"they differ in {', '.join(sorted(keys))}" if keys else ""


def verdict(differences: Sequence[Difference], reference: str) -> list[str]:
    """Return which method is better than the reference in what, in plain sentences.

    Args:
        differences: of all methods.
        reference: the method that they are compared with.

    Returns:
        What is told, what is not told apart and what cannot be told; over all data
        sets, of a method that has only one on that.
    """
    everywhere = {each.method for each in differences if each.data == ALL_DATA}
    found = [
        each
        for each in differences
        if each.data == ALL_DATA or each.method not in everywhere
    ]
    sentences = [
        f"{each.method} is {each.verdict} than {reference} in {each.quantity.name} on "
        f"{each.data}: {decimal(each.estimate.mean, '+')} points "
        f"{each.estimate.interval('+')}, {each.seeds} pairs of runs a data set."
        for each in found
        if each.told and each.estimate is not None
    ]
    rest: dict[str, dict[str, list[str]]] = {}
    for each in found:
        if not each.told:
            names = rest.setdefault(each.verdict, {}).setdefault(each.method, [])
            names.append(each.quantity.name)
    for why, methods in sorted(rest.items(), key=lambda each: each[0] == "not paired"):
        alike: dict[str, list[str]] = {}
        for method, names in methods.items():
            alike.setdefault(", ".join(dict.fromkeys(names)), []).append(method)
        sentences += [
            f"{', '.join(each)} against {reference} in {names}: {why}."
            for names, each in alike.items()
        ]
    if any(each.verdict.startswith("cannot") for each in found):
        sentences.append(
            f"A verdict needs {MIN_SEEDS} pairs of runs on every data set: over fewer "
            "seeds an interval is too narrow to rank anything."
        )
    return sentences or [f"There is nothing to compare with {reference}."]
