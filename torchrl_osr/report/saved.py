"""Which of the recoverable states each method comes back from.

Shapes: ``N`` seeds, ``M`` states.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    disturbances_of,
    recovered_share,
    saved_share,
)
from torchrl_osr.report.methods import RunTables
from torchrl_osr.report.scores import Estimate


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
        tables: of :func:`~torchrl_osr.report.read_runs`.
        reference: the method that the others are compared with.
    """
    for (data, states), rows in tables.saved.groupby(["data", "states"], sort=False):
        one = rows[rows["run"] == rows["run"].iloc[0]]
        of_each = "group", "disturbance", "walk"
        group, disturbance, walk = (one[name].to_numpy() for name in of_each)
        back = {
            method: pd.DataFrame(
                {seed: each["back"].to_numpy() for seed, each in of.groupby("seed")}
            ).T
            for method, of in rows.groupby("method", sort=False)
        }
        hard = group == GROUPS[-1]
        for method, table in back.items():
            chosen = {each: group == each for each in GROUPS if each in group}
            found = _estimates(table, walk, chosen)
            names = disturbances_of(disturbance[hard])
            chosen = {each: hard & (disturbance == each) for each in names}
            by_disturbance = _estimates(table, walk, chosen)
            recovered = None
            if method != reference and reference in back and hard.any():
                both = table.index.intersection(back[reference].index)
                ours, theirs = (of.loc[both, hard] for of in (table, back[reference]))
                recovered = _recovered(ours, theirs, walk[hard])
            seeds = [*table.index]
            yield Saved(data, states, method, seeds, found, by_disturbance, recovered)


def _estimates(
    back: pd.DataFrame, walk: np.ndarray, chosen: Mapping[str, np.ndarray]
) -> dict[str, Estimate]:
    """Shares of the states of each name."""
    return {
        name: _percent(saved_share(back.loc[:, rows], walk[rows]), len(back))
        for name, rows in chosen.items()
    }


def _recovered(
    ours: pd.DataFrame, theirs: pd.DataFrame, walk: np.ndarray
) -> Estimate | None:
    if not len(ours):
        return None
    try:
        found = recovered_share(ours, theirs, np.ones(len(walk)), walk)
    except ValueError:  # the reference saves all of them, at least in a resample
        return None
    return _percent(found, len(ours))


def _percent(found: tuple[float, float, float], seeds: int) -> Estimate:
    mean, low, high = (100 * each for each in found)
    return Estimate(mean, low, high, "seeds" if seeds > 1 else "walks")
