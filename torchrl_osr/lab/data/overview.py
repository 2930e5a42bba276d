"""Describe a recording before anything is trained on it, and find what looks wrong.

Shapes: ``N`` rows, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_osr.lab.data.rows import is_followed
from torchrl_osr.lab.data.statistics import MIN_OBSERVATION_SCALE
from torchrl_osr.lab.data.transitions import ACTION_LIMIT

PARTS = ("observation", "action", "reward")
"""Parts that are described entry by entry."""

FEW_ROWS, MOST_ROWS = 1000, 20_000
SOME, MOST = 0.1, 0.5

# A jump is so many times the change that nine in ten rows stay below.
JUMP = 20


class Entry(NamedTuple):
    """An entry of a vector, or the reward; ``missing`` rows are not finite."""

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
    """Range, mean and deviation of every entry, in the recording's own units."""
    entries, chunks = [], [some for some in rows if len(some["reward"])]
    for part in PARTS:
        arrays = [np.reshape(some[part], (len(some[part]), -1)) for some in chunks]
        table: Any = np.concatenate(arrays).T if arrays else []
        names = columns.get(part, ())
        if len(names) != len(table):
            numbered = [f"{part}[{entry}]" for entry in range(len(table))]
            names = [part] if part == "reward" else numbered
        for name, column in zip(names, table, strict=True):
            known = column[np.isfinite(column)].astype(np.float64)
            known = known if len(known) else np.full(1, np.nan)
            facts = known.min(), known.max(), known.mean(), known.std()
            missing = int((~np.isfinite(column)).sum())
            entries.append(Entry(name, part, missing, *map(float, facts)))
    return entries


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
    if len(data) < FEW_ROWS:
        yield f"there are only {len(data)} rows: record more."
    if "unmarked_ends" in manifest:
        yield from _about_episodes(manifest)
    yield from _about_next_states(data, manifest)
    yield from _about_order(data)


def _about_entries(entries: Sequence[Entry]) -> Iterator[str]:
    constant = {
        "observation": "it says nothing about the state.",
        "action": "nothing can be learnt about its effect.",
        "reward": "all policies are equally good (data.columns.reward=...).",
    }
    for name, part, _, low, _, _, deviation in entries:
        if deviation == 0:
            yield f"{name} is {low:g} in every row: {constant[part]}"
        elif part == "observation" and deviation < MIN_OBSERVATION_SCALE:
            yield (
                f"{name} has a standard deviation of {deviation:.2g} and is divided by "
                f"{MIN_OBSERVATION_SCALE}, which leaves it small: use a smaller unit."
            )


def _about_actions(data: TensorDict, names: Sequence[str]) -> Iterator[str]:
    largest, at_bounds = data["action"].abs().amax(0), actions_at_bounds(data)
    for name, most, bound in zip(
        names, largest.tolist(), at_bounds.tolist(), strict=True
    ):
        if bound > MOST:
            yield (
                f"{name} is at one of its bounds in {bound:.0%} of the rows: they may "
                "be too narrow (data.action_bounds=[low,high])."
            )
        elif most < MOST:
            yield (
                f"{name} uses {most:.0%} of the way to its bounds: they may be in "
                "another unit (data.action_bounds=[low,high])."
            )


def actions_at_bounds(data: TensorDict) -> Any:
    """Share of rows in which each action is at one of its bounds, ``[A]``."""
    return (data["action"].abs() >= ACTION_LIMIT - 1e-6).double().mean(0)


def _about_episodes(manifest: Mapping[str, Any]) -> Iterator[str]:
    kinds = ("terminated", "truncated", "unmarked")
    fell, cut, unmarked = (manifest[f"{kind}_ends"] for kind in kinds)
    lengths = manifest["episode_lengths"]
    if fell + cut + unmarked == 1:
        yield "all rows are one episode: are there more (data.columns.episode=...)?"
    elif fell > 2 and not cut + unmarked and len(set(lengths)) == 1:
        yield (
            f"all {fell} episodes are terminated after {lengths[0]} steps, like at a "
            "time limit (data.columns.truncated=... data.columns.terminated=false)."
        )
    elif unmarked > 1 and not fell + cut:
        yield (
            f"none of the {unmarked} episodes has a flag at its end: they count as cut "
            "and have no return. Mark their last rows (data.columns.truncated=...)."
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
            f"{dropped:,} of {dropped + len(data):,} rows are dropped: the last of an "
            "episode has no next state (data.columns.next_observation=...)."
        )
    change = (after - before).abs()
    usual = change[:: len(change) // MOST_ROWS + 1].quantile(0.9, dim=0)
    large = (change > JUMP * usual) & (change > SOME * before.std(0)) & (usual > 0)
    if jumps := large.any(1).nonzero()[:, 0].tolist():
        yield (
            f"in {len(jumps):,} rows, such as {jumps[0]}, the state jumps by more than "
            f"{JUMP} times its usual change: flags may be missing, or a row late."
        )


def _about_order(data: TensorDict) -> Iterator[str]:
    """Findings about rows that follow one another."""
    followed = is_followed(data)
    inside = ~data["next", "done"][:-1, 0]
    share = 1 - followed[:-1][inside].double().mean().item() if inside.any() else 0
    if share > SOME:
        yield (
            f"after {share:.0%} of the rows the next row does not begin where this one "
            "ended: sort them (data.columns.step=...) unless they are single steps."
        )
    rows = (followed[:-1] & followed[1:]).nonzero()[:MOST_ROWS, 0] + 1
    if len(rows) >= FEW_ROWS:
        same, early, late = (_explained(data, rows, shift) for shift in (0, -1, 1))
        shift, best = max((-1, early), (1, late), key=lambda each: each[1])
        if best > 0.2 and same < best / 4:
            where = "before" if shift < 0 else "after"
            yield (
                f"the action of the row {where} explains {best:.0%} of the change of "
                f"the state, that of the row itself {same:.0%}: actions may be shifted."
            )


def _explained(data: TensorDict, rows: Tensor, shift: int) -> float:
    """Share of the change of the state that actions explain linearly, given it."""
    state = data["observation"][rows].double()
    change = data["next", "observation"][rows].double() - state
    known = torch.cat([torch.ones(len(rows), 1), state], 1).double()
    both = torch.cat([known, data["action"][rows + shift].double()], 1)
    fits = (
        x @ torch.linalg.lstsq(x, change, driver="gelsd").solution
        for x in (known, both)
    )
    left = [(change - fit).square().sum(0) for fit in fits]
    return float((1 - left[1] / left[0].clamp_min(1e-12)).max())


def out_of_space(
    entries: Sequence[Entry], low: Sequence[float], high: Sequence[float]
) -> Iterator[str]:
    """Yield which observations leave the range of their task's space."""
    observed = [entry for entry in entries if entry.part == "observation"]
    for entry, least, most in zip(observed, low, high, strict=True):
        slack = 1e-3 * max(1.0, abs(entry.low), abs(entry.high))
        if entry.low < least - slack or entry.high > most + slack:
            yield (
                f"{entry.name} goes from {entry.low:g} to {entry.high:g}, where the "
                f"environment's observation has {least:g} to {most:g}: are the columns "
                "in another order (data.columns.observation=[...])?"
            )
