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

from torchrl_osr.lab.evaluation.statistics import nested_resamples, percentile_interval
from torchrl_osr.lab.report.methods import RunTables
from torchrl_osr.lab.report.scores import Estimate, counted, decimal, over_what, recent

Array = NDArray[np.float64]

ALL_DATA = "all data sets"

MIN_SEEDS = 5
"""Pairs of runs on each data set below which there is no verdict.

A bootstrap over three seeds holds the true mean in about 76 of 100 cases, over five in
83, over ten in 89: with fewer, an interval without 0 says next to nothing.
"""


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
        note: why they cannot, or that seeds are left out.
    """

    data: str
    method: str
    quantity: Quantity
    estimate: Estimate | None
    seeds: int
    note: str = ""

    @property
    def verdict(self) -> str:
        """Either "better", "worse", "not told apart" or why it cannot be told."""
        if self.estimate is None:
            return "not paired"
        if self.seeds < MIN_SEEDS:
            return f"cannot be told: {counted(self.seeds, 'seed')}"
        if self.estimate.low <= 0 <= self.estimate.high:
            return "not told apart"
        return "better" if self.estimate.mean * self.quantity.sign > 0 else "worse"

    @property
    def told(self) -> bool:
        """Whether one of the two is better."""
        return self.verdict in ("better", "worse")


def quantities(tables: RunTables) -> list[Quantity]:
    """What methods are compared in: the score or return, and two of each suite."""
    measure = "score" if tables.measure == "normalised score" else "return"
    found = [Quantity(f"undisturbed {measure}", _values(recent(tables.episodes)))]
    for suite in tables.suites:
        rows = tables.episodes[tables.episodes["suite"] == suite]
        none = rows["disturbance"] == ""
        clean, under = _values(rows[none]), _values(rows[~none])
        found += [
            Quantity(f"{measure} under {suite}", under),
            Quantity(f"{measure} lost to {suite}", clean - under, sign=-1),
        ]
    return found


def suite_quantities(tables: RunTables, suite: str) -> list[Quantity]:
    """The score under each disturbance of a suite."""
    rows = tables.episodes[tables.episodes["suite"] == suite]
    return [
        Quantity(name, _values(group))
        for name, group in rows.groupby("disturbance", sort=False)
        if name
    ]


def compare(
    tables: RunTables, method: str, reference: str, quantity: Quantity
) -> list[Difference]:
    """Compare a method with the reference on each data set, and on all together.

    Returns:
        Data set by data set, then :data:`ALL_DATA` if there are several. Data sets
        where one of the two has no such numbers are left out.
    """
    found, paired = [], []
    for data in tables.data:
        values = quantity.values[quantity.values.index.get_level_values("data") == data]
        if not {method, reference} <= set(values.index.unique("method")):
            continue
        pairs, note = pair(values.droplevel("data"), method, reference)
        estimate = mean_difference([pairs]) if pairs else None
        found.append(Difference(data, method, quantity, estimate, len(pairs), note))
        if pairs:
            paired.append(pairs)
    if len(paired) > 1:
        notes = [each.note for each in found if each.estimate]
        if len(paired) < len(tables.data):
            notes.insert(0, f"of {len(paired)} data sets")
        note = "; ".join(dict.fromkeys(filter(None, notes)))
        together, fewest = mean_difference(paired), min(map(len, paired))
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


def pair(values: pd.Series, method: str, reference: str) -> tuple[list[Array], str]:
    """Differences of the same episodes of two methods on one data set.

    Args:
        values: by ``method``, ``seed``, ``step`` and ``episode``.
        method: its name.
        reference: the other's name.

    Returns:
        Method less reference of each seed that both have, averaged over checkpoints,
        ``[E]``; a note if seeds are left out. Or nothing, and why it cannot be paired.
    """
    both = values.unstack("method")[[method, reference]].dropna(how="all")
    seeds = both.groupby("seed").count()
    common = seeds.index[(seeds > 0).all(axis=1)]
    if common.empty:
        return [], "they have no seed in common"
    both = both[both.index.get_level_values("seed").isin(common)]
    alone = both.index[both.isna().any(axis=1)]
    if len(alone):
        seed, step, episode = alone[0]
        return [], (
            f"{counted(len(alone), 'episode')} without a partner, the first of seed "
            f"{seed} at step {step:,} with episode seed {episode}"
        )
    less = (both[method] - both[reference]).groupby(["seed", "episode"]).mean()
    note = "only seeds that both have" if len(common) < len(seeds) else ""
    return [each.to_numpy() for _, each in less.groupby("seed")], note


def mean_difference(data_sets: Sequence[Sequence[Array]]) -> Estimate:
    """Mean difference, every data set and every seed with equal weight.

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


def verdict(differences: Sequence[Difference], reference: str) -> list[str]:
    """Which method is better than the reference in what, in plain sentences.

    Returns:
        First the verdicts, then what is not told apart, then what cannot be told. A
        method with several data sets is judged over all of them, any other on its only
        one.
    """
    everywhere = {each.method for each in differences if each.data == ALL_DATA}
    found = [
        each
        for each in differences
        if each.data == ALL_DATA or each.method not in everywhere
    ]
    sentences = [
        f"{each.method} is {each.verdict} than {reference} in {each.quantity.name} on "
        f"{each.data}: {decimal(each.estimate.mean, '+')} "
        f"{each.estimate.interval('+')}, {each.seeds} pairs of runs a data set."
        for each in found
        if each.told and each.estimate
    ]
    rest = pd.DataFrame(
        [(e.verdict, e.method, e.quantity.name) for e in found if not e.told],
        columns=["why", "method", "quantity"],
    ).drop_duplicates()
    rest = rest.sort_values("why", key=lambda why: why == "not paired", kind="stable")
    by_method = rest.groupby(["why", "method"], sort=False)["quantity"].agg(", ".join)
    alike = by_method.reset_index().groupby(["why", "quantity"], sort=False)["method"]
    for (why, names), methods in alike:
        sentences.append(f"{', '.join(methods)} against {reference} in {names}: {why}.")
    if rest["why"].str.startswith("cannot").any():
        sentences.append(
            f"A verdict needs {MIN_SEEDS} pairs of runs on every data set: over fewer "
            "seeds an interval is too narrow to rank anything."
        )
    return sentences or [f"There is nothing to compare with {reference}."]


def _values(rows: pd.DataFrame) -> pd.Series:
    """Mean score of each episode over the disturbances in the rows."""
    return rows.groupby(["data", "method", "seed", "step", "episode"])["score"].mean()
