"""Describe a recording before anything is trained on it, and find what looks wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_osr.lab.data.columns import has_rewards
from torchrl_osr.lab.data.rows import is_followed
from torchrl_osr.lab.data.transitions import ACTION_LIMIT

CONSTANT = {
    "observation": "it says nothing about the state.",
    "action": "nothing can be learnt about its effect.",
    "reward": "all policies are equally good (data.columns.reward=...).",
}

FEW_ROWS, MOST_ROWS = 1000, 20_000
FEW, SOME, MOST = 0.02, 0.1, 0.5

# A jump is so many times the change that nine in ten rows stay below.
JUMP = 20


def recorded_columns(data: TensorDict, manifest: Mapping[str, Any]) -> pd.DataFrame:
    """Return the rows in the recording's own units; columns are ``(part, name)``."""
    low, high = map(torch.tensor, manifest.get("action_bounds", (-1.0, 1.0)))
    action = low + (data["action"] + 1) / 2 * (high - low)
    if manifest.get("num_actions") is not None:
        action = data["action"].argmax(1, keepdim=True)
    parts = {"observation": data["observation"], "action": action}
    parts["reward"] = data["next", "reward"]
    frames = {}
    for part, table in parts.items():
        read, entries = manifest.get("columns", {}), manifest.get("entry_names", {})
        names = [n for each in read.get(part, ()) for n in entries.get(each) or [each]]
        if len(names) != table.shape[1]:
            numbered = [f"{part}[{entry}]" for entry in range(table.shape[1])]
            names = [part] if part == "reward" else numbered
        frames[part] = pd.DataFrame(table.double().numpy(), columns=names)
    return pd.concat(frames, axis=1)


def findings(
    data: TensorDict, manifest: Mapping[str, Any], entries: pd.DataFrame
) -> Iterator[str]:
    """Yield what looks wrong with a data set that can be trained on, and the cure.

    ``entries`` has ``min`` and ``max`` of each of :func:`recorded_columns`.
    """
    yield from manifest.get("warnings", [])
    # If episodes can terminate, a constant reward still favours long ones.
    falls = bool(data["next", "terminated"].any())
    for (part, name), entry in entries.iterrows():
        meant = part == "reward" and (falls or not has_rewards(manifest))
        if entry["min"] == entry["max"] and not meant:
            yield f"{name} is {entry['min']:g} in every row: {CONSTANT[part]}"
    if manifest.get("num_actions") is None:
        shares, sizes = actions_at_bounds(data), data["action"].abs().amax(0)
        names = entries.loc["action"].index
        for name, share, size in zip(names, shares, sizes, strict=True):
            if share > MOST:
                yield (
                    f"{name} is at one of its bounds in {share:.0%} of the rows: they "
                    "may be too narrow (data.action_bounds=[low,high])."
                )
            if 0 < size < FEW:
                yield (
                    f"{name} stays within {size:.1%} of its bounds: it may have other "
                    "units than the bounds (data.action_bounds=[low,high])."
                )
    fell, lengths = manifest.get("terminated_ends"), manifest.get("episode_lengths", [])
    if len(lengths) > 2 and len({*lengths}) == 1 and fell == len(lengths):
        yield (
            f"all {fell} episodes are terminated after {lengths[0]} steps, like at a "
            "time limit (data.columns.truncated=... data.columns.terminated=false)."
        )
    yield from _about_order(data)


def actions_at_bounds(data: TensorDict) -> Any:
    """Return the share of rows with each action at one of its bounds, ``[A]``."""
    return (data["action"].abs() >= ACTION_LIMIT - 1e-6).double().mean(0)


def _about_order(data: TensorDict) -> Iterator[str]:
    """Yield findings about states and rows that follow one another."""
    before, after = data["observation"], data["next", "observation"]
    change = (after - before).abs()
    usual = change[:: len(change) // MOST_ROWS + 1].quantile(0.9, dim=0)
    large = (change > JUMP * usual) & (change > SOME * before.std(0)) & (usual > 0)
    if jumps := large.any(1).nonzero()[:, 0].tolist():
        yield (
            f"in {len(jumps):,} rows, such as {jumps[0]} of the {len(data):,} to train "
            f"on, the state jumps by more than {JUMP} times its usual change: an angle "
            "may wrap, or a flag be missing."
        )
    # A terminated row of a log may repeat its own state.
    still = ((change == 0).all(1) & ~data["next", "terminated"][:, 0]).double().mean()
    if still > 0.5:
        yield (
            f"in {still:.0%} of the rows the state does not change: the sensors may be "
            "slower than the log."
        )
    followed = is_followed(data)
    inside = ~data["next", "done"][:-1, 0]
    share = 1 - followed[:-1][inside].double().mean().item() if inside.any() else 0
    if share > SOME:
        yield (
            f"after {share:.0%} of the rows the next row does not begin where this one "
            "ended: sort them (data.columns.step=...) unless they are single steps."
        )
    parts = data["observation"], data["action"], data["next", "reward"]
    whole = pd.DataFrame(torch.cat(parts, 1).numpy())
    double = pd.util.hash_pandas_object(whole, index=False).duplicated()
    if double.mean() > SOME / 10:
        yield (
            f"{double.sum():,} rows, such as {double.idxmax()}, repeat an earlier one: "
            "rows may be double."
        )
    rows = (followed[:-1] & followed[1:]).nonzero()[:MOST_ROWS, 0] + 1
    if len(rows) >= FEW_ROWS:
        same, early, late = (_explained(data, rows, shift) for shift in (0, -1, 1))
        where, best = max(("before", early), ("after", late), key=lambda each: each[1])
        if best > 0.2 and same < best / 4:
            yield (
                f"the action of the row {where} explains {best:.0%} of the change of "
                f"the state, that of the row itself {same:.0%}: actions may be "
                "shifted, or the rows in reverse order."
            )


def _explained(data: TensorDict, rows: Tensor, shift: int) -> float:
    """Return the share of the state's change that actions explain linearly."""
    state = data["observation"][rows].double()
    change = data["next", "observation"][rows].double() - state
    known = torch.cat([torch.ones(len(rows), 1), state], 1).double()
    both = torch.cat([known, data["action"][rows + shift].double()], 1)
    fits = (
        x @ torch.linalg.lstsq(x, change, driver="gelsd").solution
        for x in (known, both)
    )
    left = [(change - fit).square().sum(0) for fit in fits]
    return float(((left[0] - left[1]) / left[0].clamp_min(1e-12)).max())


def out_of_space(
    entries: pd.DataFrame, low: Sequence[float], high: Sequence[float]
) -> Iterator[str]:
    """Yield which observations leave the range of their task's space."""
    observed = entries.loc["observation"].iterrows()
    for (name, entry), least, most in zip(observed, low, high, strict=True):
        first, last = entry["min"], entry["max"]
        slack = 1e-3 * max(1.0, abs(first), abs(last))
        if first < least - slack or last > most + slack:
            yield (
                f"{name} goes from {first:g} to {last:g}, where the environment's "
                f"observation has {least:g} to {most:g}: are the columns in another "
                "order (data.columns.observation=[...])?"
            )
