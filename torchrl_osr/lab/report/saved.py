"""Which of the recoverable states each method comes back from.

Shapes: ``N`` seeds, ``M`` states.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr.lab.evaluation.recoverable import GROUPS, disturbances_of
from torchrl_osr.lab.evaluation.statistics import recovered_share, saved_share
from torchrl_osr.lab.report.methods import RunTables
from torchrl_osr.lab.report.scores import Estimate, over_what


class Saved(NamedTuple):
    """A method on the states of a data set's task.

    Attributes:
        data: the data set.
        states: half and mark of the states.
        method: its name.
        seeds: of its runs.
        shares: percent saved, by group.
        by_disturbance: of the recoverable ones, by kind and strength.
        recovered: percent that it saves of the recoverable states that the reference
            does not save, over the seeds of both; ``None`` if there are none, or the
            reference saves all.
    """

    data: str
    states: str
    method: str
    seeds: list[int]
    shares: dict[str, Estimate]
    by_disturbance: dict[str, Estimate]
    recovered: Estimate | None


def saved_states(tables: RunTables, reference: str) -> Iterator[Saved]:
    """What each method saves, data set by data set.

    Args:
        tables: of :func:`~torchrl_osr.lab.report.read_runs`.
        reference: the method that the others are compared with.
    """
    for data, states, of_each, back in came_back(tables):
        columns = "group", "disturbance", "walk"
        group, disturbance, walk = (of_each[name].to_numpy() for name in columns)
        hard = group == GROUPS[-1]
        methods = back.index.unique("method")
        for method in methods:
            table = back.loc[method]
            chosen = {each: group == each for each in GROUPS if each in group}
            found = _estimates(table, walk, chosen)
            names = disturbances_of(disturbance[hard])
            chosen = {each: hard & (disturbance == each) for each in names}
            by_disturbance = _estimates(table, walk, chosen)
            recovered = None
            if method != reference and reference in methods and hard.any():
                theirs = back.loc[reference]
                both = table.index.intersection(theirs.index)
                ours, theirs = (of.loc[both, hard] for of in (table, theirs))
                recovered = _recovered(ours, theirs, walk[hard])
            seeds = [*table.index]
            yield Saved(data, states, method, seeds, found, by_disturbance, recovered)


def came_back(
    tables: RunTables,
) -> Iterator[tuple[str, str, pd.DataFrame, pd.DataFrame]]:
    """Which states each run comes back from, data set by data set.

    Args:
        tables: of :func:`~torchrl_osr.lab.report.read_runs`.

    Yields:
        The data set; half and mark of its states; ``group``, ``disturbance`` and
        ``walk`` of each, ``M`` rows; and how often each was come back from, ``M``
        columns and a row for each ``method`` and ``seed``, in the order of the runs.
    """
    for (data, states), rows in tables.saved.groupby(["data", "states"], sort=False):
        rows = rows.assign(state=rows.groupby("run").cumcount())
        of_each = rows.drop_duplicates("state").set_index("state")
        keys = ["method", "seed"]
        back = rows.pivot(index=keys, columns="state", values="back").astype(float)
        order = pd.MultiIndex.from_frame(rows[keys].drop_duplicates())
        yield data, states, of_each, back.loc[order]


def _estimates(
    back: pd.DataFrame, walk: np.ndarray, chosen: Mapping[str, np.ndarray]
) -> dict[str, Estimate]:
    """Shares of the states of each name."""
    return {
        name: percent(saved_share(back.loc[:, rows], walk[rows]), len(back))
        for name, rows in chosen.items()
    }


def _recovered(
    ours: pd.DataFrame, theirs: pd.DataFrame, walk: np.ndarray
) -> Estimate | None:
    if not len(ours):
        return None
    try:
        found = recovered_share(ours, theirs, walk)
    except ValueError:  # the reference saves all of them, at least in a resample
        return None
    return percent(found, len(ours))


def percent(found: tuple[float, float, float], seeds: int) -> Estimate:
    """A share and its interval, over so many seeds."""
    mean, low, high = (100 * each for each in found)
    return Estimate(mean, low, high, over_what([range(seeds)], alone="walks"))
