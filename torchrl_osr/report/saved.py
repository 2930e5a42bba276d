"""Which of the recoverable states each method comes back from.

Shapes: ``N`` seeds, ``M`` states.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr.evaluation.recoverable import GROUPS, recovered_share, saved_share
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
        recovered: percent that it saves of the recoverable states that the reference
            does not save, over the seeds of both; ``None`` if there are none, or the
            reference saves all.
    """

    data: str
    states: str
    method: str
    seeds: list[int]
    shares: dict[str, Estimate]
    recovered: Estimate | None


def saved_states(tables: RunTables, reference: str) -> Iterator[Saved]:
    """What each method saves, data set by data set.

    Args:
        tables: of :func:`~torchrl_osr.report.read_runs`.
        reference: the method that the others are compared with.
    """
    for (data, states), rows in tables.saved.groupby(["data", "states"], sort=False):
        one = rows[rows["run"] == rows["run"].iloc[0]]
        group, walk = one["group"].to_numpy(), one["walk"].to_numpy()
        back = {
            method: pd.DataFrame(
                {seed: each["back"].to_numpy() for seed, each in of.groupby("seed")}
            ).T
            for method, of in rows.groupby("method", sort=False)
        }
        hard = group == GROUPS[-1]
        for method, table in back.items():
            found = {
                each: _estimate(table.loc[:, group == each], walk[group == each])
                for each in GROUPS
                if each in group
            }
            recovered = None
            if method != reference and reference in back and hard.any():
                both = table.index.intersection(back[reference].index)
                ours, theirs = (of.loc[both, hard] for of in (table, back[reference]))
                recovered = _recovered(ours, theirs, walk[hard])
            yield Saved(data, states, method, [*table.index], found, recovered)


def _estimate(back: pd.DataFrame, walk: np.ndarray) -> Estimate:
    return _percent(saved_share(back, walk), len(back))


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
