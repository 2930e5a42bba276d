"""Is one method better than another? Differences of the same episodes.

Two runs are compared if they have the same data set and seed, and episode by episode
if these have the same checkpoint and start state. Intervals resample seeds, then
episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.evaluation import nested_resamples, percentile_interval
from torchrl_osr.report.checks import cells, data_of
from torchrl_osr.report.methods import METHOD, comparable
from torchrl_osr.report.quantities import Episodes, Quantity
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import Estimate, over_what

Array = NDArray[np.float64]
ALL_DATA = "all data sets"


class Comparison(NamedTuple):
    """A method against the reference, in one quantity on one data set or all.

    Attributes:
        data: a data set, or :data:`ALL_DATA`.
        method: which is compared.
        quantity: in what.
        difference: method less reference; ``None`` if they cannot be paired.
        seeds: pairs of runs.
        note: why they cannot, or what else differs between them.
    """

    data: str
    method: str
    quantity: Quantity
    difference: Estimate | None
    seeds: int
    note: str = ""

    @property
    def verdict(self) -> str:
        """Return "better", "worse", "not told apart" or "not paired"."""
        if self.difference is None:
            return "not paired"
        if self.difference.low <= 0 <= self.difference.high:
            return "not told apart"
        better = self.difference.mean * self.quantity.sign > 0
        return "better" if better else "worse"


def pair(own: Episodes, reference: Episodes) -> Array:
    """Return the differences of two runs' episodes, averaged over checkpoints, ``[E]``.

    Raises:
        ValueError: if an episode of one is not there in the other.
    """
    alone = own.keys() ^ reference.keys()
    if alone:
        step, seed = min(alone)
        raise ValueError(
            f"{len(alone)} episodes have no partner, the first at step {step:,} with "
            f"episode seed {seed}"
        )
    seeds = sorted({seed for _, seed in own})
    return np.array(
        [
            np.mean([own[key] - reference[key] for key in own if key[1] == seed])
            for seed in seeds
        ]
    )


def compare(
    runs: Sequence[Run], method: str, reference: str, quantity: Quantity
) -> list[Comparison]:
    """Compare a method with the reference on each data set, and on all together.

    Args:
        runs: all of the report.
        method: its name.
        reference: the other's name.
        quantity: in what.

    Returns:
        Data set by data set, then :data:`ALL_DATA` if there are several. Data sets
        where one of the two has no such numbers are left out.
    """
    found, differences = [], []
    for data in data_of(runs):
        own, other = (
            _by_seed(runs, data, name, quantity) for name in (method, reference)
        )
        if not own or not other:
            continue
        try:
            pairs, note = _paired(own, other, quantity)
        except ValueError as error:
            found.append(Comparison(data, method, quantity, None, 0, str(error)))
            continue
        differences.append(pairs)
        found.append(
            Comparison(data, method, quantity, difference([pairs]), len(pairs), note)
        )
    if len(differences) > 1:
        notes = [each.note for each in found if each.difference is not None]
        if len(differences) < len(data_of(runs)):
            notes.insert(0, f"of {len(differences)} data sets")
        together, count = difference(differences), sum(map(len, differences))
        note = "; ".join(dict.fromkeys(filter(None, notes)))
        found.append(Comparison(ALL_DATA, method, quantity, together, count, note))
    return found


def _paired(
    own: dict[int, Run], other: dict[int, Run], quantity: Quantity
) -> tuple[list[Array], str]:
    """Return the differences of each seed that both have, and what to note about it.

    Raises:
        ValueError: if there is none, or episodes do not match.
    """
    seeds = sorted(own.keys() & other.keys())
    if not seeds:
        raise ValueError("they have no seed in common")
    pairs = [
        pair(quantity.values(own[seed]) or {}, quantity.values(other[seed]) or {})
        for seed in seeds
    ]
    notes = [_caveat([(own[seed], other[seed]) for seed in seeds])]
    if len(seeds) < len(own.keys() | other.keys()):
        notes.append("only seeds that both have")
    return pairs, "; ".join(filter(None, notes))


def difference(data_sets: Sequence[Sequence[Array]]) -> Estimate:
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
    low, high = percentile_interval(np.mean(resamples, axis=0)[:, 0])
    return Estimate(float(point), float(low), float(high), over_what(data_sets))


def _by_seed(
    runs: Sequence[Run], data: str, method: str, quantity: Quantity
) -> dict[int, Run]:
    """Return the runs that have the quantity, by seed."""
    group = cells(runs).get((data, method), [])
    return {run.seed: run for run in group if quantity.values(run) is not None}


def _caveat(pairs: Sequence[tuple[Run, Run]]) -> str:
    """Return in which settings the partners differ, beside their methods."""
    keys = set()
    for own, other in pairs:
        mine, theirs = comparable(own), comparable(other)
        keys |= {
            key
            for key in mine.keys() | theirs.keys()
            if not key.startswith(METHOD) and mine.get(key) != theirs.get(key)
        }
        if own.versions != other.versions:
            keys.add("versions")
    return f"they differ in {', '.join(sorted(keys))}" if keys else ""
