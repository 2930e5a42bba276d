"""What a recording looks like before anything is trained on it, and what looks wrong.

Shapes: ``N`` rows, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr.lab.data.store.statistics import MIN_OBSERVATION_SCALE
from torchrl_osr.lab.data.store.validation import ACTION_LIMIT

PARTS = ("observation", "action", "reward")
"""What is described entry by entry."""

FEW_ROWS = 1000
SOME = 0.1
MOST = 0.5


class Entry(NamedTuple):
    """One number of each row: an entry of a vector, or the reward.

    Attributes:
        name: of its column in the file, or of the part and the place in it.
        part: one of ``PARTS``.
        missing: rows in which it is not finite; the others count below.
        low, high, mean, deviation: in the recording's own units.
    """

    name: str
    part: str
    missing: int
    low: float
    high: float
    mean: float
    deviation: float


def describe_entries(
    rows: Iterable[Mapping[str, Any]], columns: Mapping[str, Sequence[str]]
) -> list[Entry]:
    """Range, mean and deviation of every entry.

    Args:
        rows: some rows at a time, ``observation`` ``[n, S]``, ``action`` ``[n, A]``
            and ``reward`` ``[n]``, as they were recorded.
        columns: names of the file's columns, by part. A part without them has its
            entries numbered.
    """
    first: dict[str, NDArray[np.float64]] = {}
    sums: dict[str, NDArray[np.float64]] = {}
    ranges: dict[str, NDArray[np.float64]] = {}
    for some, part in ((some, part) for some in rows for part in PARTS):
        if len(some[part]):
            array = np.asarray(some[part], np.float64).reshape(len(some[part]), -1)
            known = np.isfinite(array)
            # From the first row on: sums of squares of large numbers lose digits.
            start = first.setdefault(part, np.where(known[0], array[0], 0.0))
            moved = np.where(known, array - start, 0.0)
            found = [(~known).sum(0), known.sum(0), moved.sum(0), (moved**2).sum(0)]
            sums[part] = sums.get(part, 0.0) + np.array(found)
            options: dict[str, Any] = {"axis": 0, "where": known, "initial": np.inf}
            outer = np.array([array.min(**options), (-array).min(**options)])
            ranges[part] = np.minimum(ranges.get(part, np.inf), outer)
    entries = []
    for part, (missing, count, moved, squares) in sums.items():
        mean = moved / np.maximum(count, 1)
        variance = np.maximum(squares / np.maximum(count, 1) - mean**2, 0)
        low, high = ranges[part][0], -ranges[part][1]
        table = np.c_[missing, low, high, first[part] + mean, np.sqrt(variance)]
        names = _names(part, len(table), columns.get(part, ()))
        entries += [
            Entry(name, part, int(row[0]), *row[1:])
            for name, row in zip(names, table.tolist(), strict=True)
        ]
    return entries


def _names(part: str, size: int, columns: Sequence[str]) -> Sequence[str]:
    if len(columns) == size:
        return columns
    return [part] if part == "reward" else [f"{part}[{entry}]" for entry in range(size)]


def findings(
    data: TensorDict, manifest: Mapping[str, Any], entries: Sequence[Entry]
) -> Iterator[str]:
    """Yield what looks wrong with a data set that can be trained on, and the cure."""
    yield from manifest.get("warnings", [])
    # Where episodes end by themselves, to last long is worth something.
    falls = bool(data["next", "terminated"].any())
    yield from _about_entries([e for e in entries if e.part != "reward" or not falls])
    if manifest.get("num_actions") is None:
        yield from _about_actions(data, [e.name for e in entries if e.part == "action"])
    yield from _about_episodes(data, manifest)
    yield from _about_next_states(data, manifest)


def _about_entries(entries: Sequence[Entry]) -> Iterator[str]:
    for name, part, _, low, _, _, deviation in entries:
        if deviation == 0:
            yield (
                f"{name} is {low:g} in every row: "
                + {
                    "observation": "leave it out (data.columns.observation=[...]).",
                    "action": "nothing can be learnt of what it does; leave it out "
                    "(data.columns.action=[...]) unless the task needs it.",
                    "reward": "all policies are equally good; name another column "
                    "(data.columns.reward=...).",
                }[part]
            )
        elif part == "observation" and deviation < MIN_OBSERVATION_SCALE:
            yield (
                f"{name} has a standard deviation of {deviation:.2g} and is divided by "
                f"{MIN_OBSERVATION_SCALE} when standardised, which leaves it small: "
                "record it in a smaller unit."
            )


def _about_actions(data: TensorDict, names: Sequence[str]) -> Iterator[str]:
    largest = data["action"].abs().amax(0).tolist()
    for name, most, bound in zip(
        names, largest, actions_at_bounds(data).tolist(), strict=True
    ):
        if bound > MOST:
            yield (
                f"{name} is at one of its bounds in {bound:.0%} of the rows: unless "
                "the controller switches between them, the bounds are too narrow "
                "(data.action_bounds=[low,high])."
            )
        elif most < MOST:
            yield (
                f"{name} uses {most:.0%} of the way to its bounds: if it was recorded "
                "in another unit, say what the bounds are in that unit "
                "(data.action_bounds=[low,high])."
            )


def actions_at_bounds(data: TensorDict) -> Any:
    """Share of rows in which each action is at one of its bounds, ``[A]``."""
    return (data["action"].abs() >= ACTION_LIMIT - 1e-6).double().mean(0)


def _about_episodes(data: TensorDict, manifest: Mapping[str, Any]) -> Iterator[str]:
    if len(data) < FEW_ROWS:
        yield f"there are only {len(data)} rows: record more."
    if "unmarked_ends" not in manifest:
        return
    fell, cut, unmarked = (
        manifest[f"{kind}_ends"] for kind in ("terminated", "truncated", "unmarked")
    )
    lengths = manifest["episode_lengths"]
    if fell + cut + unmarked == 1:
        yield (
            "all rows are one episode: if there were more, name the column that tells "
            "them apart (data.columns.episode=...)."
        )
    elif fell > 2 and not cut + unmarked and len(set(lengths)) == 1:
        yield (
            f"all {fell} episodes are terminated after {lengths[0]} steps: that looks "
            "like a time limit; name the column as truncated "
            "(data.columns.truncated=... data.columns.terminated=false)."
        )
    elif unmarked > 1 and not fell + cut:
        yield (
            f"none of the {unmarked} episodes has a flag at its end, so that they "
            "count as cut and have no return: if they are whole, name or add a column "
            "that is 1 in their last rows (data.columns.truncated=...)."
        )


def _about_next_states(data: TensorDict, manifest: Mapping[str, Any]) -> Iterator[str]:
    before, after = data["observation"], data["next", "observation"]
    still = (before == after).all(1).double().mean().item()
    if still > SOME:
        yield (
            f"in {still:.0%} of the rows the next state is the state itself: the log "
            "may repeat rows, or next_observation may be the same column."
        )
    dropped = manifest.get("dropped_rows", 0)
    if dropped > SOME * (dropped + len(data)):
        yield (
            f"{dropped:,} of {dropped + len(data):,} rows are dropped, because no next "
            "state was recorded for the last of an episode: record it "
            "(data.columns.next_observation=...)."
        )
    inside = ~data["next", "done"][:-1, 0]
    breaks = (
        (before[1:] - after[:-1]).abs() > 1e-4 * before[1:].abs().clamp_min(1.0)
    ).any(1)
    if len(data) > 1 and (share := breaks[inside].double().mean().item()) > SOME:
        yield (
            f"after {share:.0%} of the rows the next row does not begin where this one "
            "ended: that is fine for single transitions; else sort them "
            "(data.columns.step=...)."
        )


def out_of_space(
    entries: Sequence[Entry], low: Sequence[float], high: Sequence[float]
) -> Iterator[str]:
    """Yield which observations leave the range that their task's space has."""
    observed = [entry for entry in entries if entry.part == "observation"]
    for entry, least, most in zip(observed, low, high, strict=True):
        slack = 1e-3 * max(1.0, abs(entry.low), abs(entry.high))
        if entry.low < least - slack or entry.high > most + slack:
            yield (
                f"{entry.name} goes from {entry.low:g} to {entry.high:g}, where the "
                f"environment's observation has {least:g} to {most:g}: the columns "
                "may be in another order (data.columns.observation=[...])."
            )
