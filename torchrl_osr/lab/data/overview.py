"""Describe a recording before anything is trained on it, and find what looks wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_osr.lab.data.rows import is_followed
from torchrl_osr.lab.data.transitions import ACTION_LIMIT

CONSTANT = {
    "observation": "it says nothing about the state.",
    "action": "nothing can be learnt about its effect.",
    "reward": "all policies are equally good (data.columns.reward=...).",
}
PARTS = tuple(CONSTANT)
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
    entries, chunks = [], [*rows]
    for part in PARTS if chunks else ():
        arrays = [np.reshape(each[part], (len(each[part]), -1)) for each in chunks]
        table = np.concatenate(arrays).astype(np.float64)
        names = columns.get(part, ())
        if len(names) != table.shape[1]:
            numbered = [f"{part}[{entry}]" for entry in range(table.shape[1])]
            names = [part] if part == "reward" else numbered
        known = pd.DataFrame(table, columns=names).where(np.isfinite(table))
        facts = known.isna().sum(), known.min(), known.max(), known.mean()
        each_fact = zip(names, *facts, known.std(ddof=0), strict=True)
        entries += [Entry(name, part, *numbers) for name, *numbers in each_fact]
    return entries


def findings(
    data: TensorDict, manifest: Mapping[str, Any], entries: Sequence[Entry]
) -> Iterator[str]:
    """Yield what looks wrong with a data set that can be trained on, and the cure."""
    yield from manifest.get("warnings", [])
    # Where episodes end by themselves, to last long is worth something.
    falls = bool(data["next", "terminated"].any())
    for name, part, _, low, high, *_ in entries:
        if low == high and not (part == "reward" and falls):
            yield f"{name} is {low:g} in every row: {CONSTANT[part]}"
    if manifest.get("num_actions") is None:
        names = [entry.name for entry in entries if entry.part == "action"]
        shares = actions_at_bounds(data).tolist()
        for name, share in zip(names, shares, strict=True):
            if share > MOST:
                yield (
                    f"{name} is at one of its bounds in {share:.0%} of the rows: they "
                    "may be too narrow (data.action_bounds=[low,high])."
                )
    fell, lengths = manifest.get("terminated_ends"), manifest.get("episode_lengths", [])
    if len(lengths) > 2 and len({*lengths}) == 1 and fell == len(lengths):
        yield (
            f"all {fell} episodes are terminated after {lengths[0]} steps, like at a "
            "time limit (data.columns.truncated=... data.columns.terminated=false)."
        )
    yield from _about_jumps(data)
    yield from _about_order(data)


def actions_at_bounds(data: TensorDict) -> Any:
    """Share of rows in which each action is at one of its bounds, ``[A]``."""
    return (data["action"].abs() >= ACTION_LIMIT - 1e-6).double().mean(0)


def _about_jumps(data: TensorDict) -> Iterator[str]:
    before, after = data["observation"], data["next", "observation"]
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
        where, best = max(("before", early), ("after", late), key=lambda each: each[1])
        if best > 0.2 and same < best / 4:
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
