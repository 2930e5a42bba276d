"""Recorded columns become transitions.

Shapes: ``N`` rows, ``E`` trajectories, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr._checks import check_choice
from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data.store import Dataset
from torchrl_osr.lab.data.transitions import (
    ACTION_LIMIT,
    SAME_STATE,
    Array,
    as_transitions,
    check_dataset,
)

ActionBounds = tuple[ArrayLike, ArrayLike]
"""Lowest and highest action, numbers or ``[A]``."""

Columns = Mapping[str, Any]

WARNINGS = {
    "actions_outside": "had actions outside their bounds, which were clipped",
    "missing_rows": "were left out: values were missing (data.missing)",
    "reset_rows": "were left out: they begin where an episode ended, with a reward of "
    "0, as a vector environment records its resets",
}

NO_REWARDS = (
    "The data have no reward column: name it (data.columns.reward=...), or train what "
    "needs none, as loss=bc, loss=noisy_bc or loss=bc recovery=osr do."
)

# A bound may be exceeded by float32 arithmetic, not by an unclipped policy.
ROUNDING = 1e-5

MARGIN = 0.05
"""Between the log's largest actions and their bounds, where none are given."""


def has_rewards(manifest: Mapping[str, Any]) -> bool:
    """Return whether the rewards of a data set were recorded; else they are 0."""
    return "reward" in manifest.get("columns", ["reward"])


@dataclass(frozen=True)
class Reading:
    """Options for recorded columns, see :func:`transitions_from_columns`."""

    action_bounds: Any = (-1.0, 1.0)
    clip_actions: bool = False
    num_actions: int | None = None
    missing: str = "error"

    def __post_init__(self) -> None:
        check_choice("data.missing", self.missing, ("error", "row", "episode"))
        bounds = self.action_bounds
        listed = np.shape(bounds)[:1] == (2,)
        if bounds is not None and not listed and bounds != "log":
            raise ValueError(
                f"data.action_bounds={bounds}; expected [lowest, highest]."
            )


def convert(
    parts: Iterable[tuple[str, Columns]],
    options: Reading,
    about: Mapping[str, Any],
    files: Iterable[Path] = (),
) -> Dataset:
    """Return transitions ``[N]`` and their manifest, with the checksum of ``files``.

    Each part has its place, such as ``"a.csv: "``, and columns of whole trajectories.
    ``about`` goes into the manifest; a reader may fill it while it yields its parts.
    """
    found: list[str] = []
    if options.action_bounds == "log":
        parts = [*parts]
        bounds = _range(part for _, part in parts)
        options = replace(options, action_bounds=bounds)
        low, high = (f"[{', '.join(f'{x:.4g}' for x in each)}]" for each in bounds)
        found.append(
            f"The bounds of the actions are {low} and {high}, the range of the log and "
            f"{MARGIN:.0%} on either side: data.action_bounds=[low,high] sets others."
        )
    rows, episodes, counts = [], [], Counter[str]()
    for place, columns in parts:
        try:
            data, numbers, of_each = trajectories(columns, options)
        except ValueError as error:
            raise ValueError(f"{place}{error}") from error
        found += _vanishing(columns)
        counts.update(numbers)
        rows.append(data)
        episodes.append(of_each)
    data = torch.cat(rows) if rows[1:] else rows[0]
    if not len(data):
        raise ValueError("no row has all values and a next state (next_observation).")
    check_dataset(data)
    returns, lengths, complete = np.concatenate(episodes).T
    whole, lengths = complete == 1, lengths.astype(int)
    warnings = [*about.get("warnings", []), *dict.fromkeys(found)]
    warnings += [f"{counts[n]:,} rows {s}." for n, s in WARNINGS.items() if counts[n]]
    for warning in warnings:
        torchrl_logger.warning(warning)
    bounds = [np.asarray(b, np.float64).tolist() for b in options.action_bounds]
    digests = "".join(map(sha256_of, files))
    return data, {
        **asdict(options),
        "action_bounds": bounds,
        "num_transitions": len(data),
        **about,
        **counts,
        **({"checksum": sha256(digests.encode()).hexdigest()} if digests else {}),
        "episode_returns": returns[whole].tolist(),
        "episode_lengths": lengths[whole].tolist(),
        "incomplete_returns": returns[~whole].tolist(),
        "incomplete_lengths": lengths[~whole].tolist(),
        "warnings": warnings,
    }


def _range(parts: Iterable[Columns]) -> list[list[float]]:
    """Return the log's lowest and highest actions, with :data:`MARGIN`."""
    actions = [np.asarray(part["action"], np.float64) for part in parts]
    low = np.min([np.nanmin(each, 0) for each in actions], 0)
    high = np.max([np.nanmax(each, 0) for each in actions], 0)
    slack = np.where(low < high, MARGIN * (high - low), 1.0)
    return [(low - slack).tolist(), (high + slack).tolist()]


def _vanishing(columns: Columns) -> Iterator[str]:
    """Yield a warning for each entry with changes that float32 loses."""
    for name in ("observation", "reward"):
        array = np.reshape(columns[name], (len(columns["reward"]), -1))
        moved = np.diff(array, axis=0) != 0
        lost = moved & (np.diff(array.astype(np.float32), axis=0) == 0)
        counts = lost.sum(0)
        for entry in np.flatnonzero(counts > 0.01 * moved.sum(0)):
            yield (
                f"{counts[entry]:,} changes of {name}[{entry}] from row to row "
                "vanish in float32: subtract a constant (of a clock, its first value)."
            )


def transitions_from_columns(
    columns: Columns,
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    num_actions: int | None = None,
    missing: str = "error",
) -> Dataset:
    """Turn recorded steps, in order of time, into transitions and their manifest.

    A trajectory ends where a row is terminated or truncated, where the episode number
    changes, and at the last row; an end without a flag becomes ``truncated``. Without
    ``next_observation``, a row's next state is the observation of the following row.
    The last row of a trajectory has no next state. If it is terminated, it stays with
    its own observation in that place, which no loss reads. Otherwise it is dropped, and
    the row before it becomes ``truncated``.

    Args:
        columns: ``observation`` ``[N, S]``, ``action`` ``[N, A]``, ``reward`` and
            ``terminated`` ``[N]`` or ``[N, 1]``; of the same shape ``truncated`` or
            ``episode`` (whole numbers) or both; possibly ``next_observation``
            ``[N, S]``. Flags are bool, or 0 and 1 of any type.

    Keyword Args:
        action_bounds: lowest and highest action, mapped to -1 and 1. The actions are
            then clipped to ±0.999.
        clip_actions: clip actions outside their bounds rather than raise.
        num_actions: number of discrete actions: ``action`` then holds their numbers
            from 0, ``[N]``, and becomes one-hot. Default: continuous actions.
        missing: ``"row"`` leaves out rows with missing values (NaN) and cuts their
            trajectories there, ``"episode"`` leaves out their trajectories,
            ``"error"`` raises. Default: ``"error"``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.lab.data import transitions_from_columns
        >>> columns = {
        ...     "observation": np.arange(1.0, 9.0).reshape(4, 2),
        ...     "action": np.full((4, 1), 0.5),
        ...     "reward": np.ones(4),
        ...     "terminated": [False, True, False, False],
        ...     "truncated": [False, False, False, True],
        ... }
        >>> data, manifest = transitions_from_columns(columns)
        >>> data["next", "observation"].tolist()  # of row 1: no loss reads it
        [[3.0, 4.0], [3.0, 4.0], [7.0, 8.0]]
        >>> manifest["dropped_rows"], manifest["episode_returns"]
        (1, [2.0, 2.0])
    """
    options = Reading(action_bounds, clip_actions, num_actions, missing)
    return convert([("", columns)], options, {})


def trajectories(
    rows: Columns, options: Reading
) -> tuple[TensorDict, dict[str, int], Array]:
    """Return transitions of whole trajectories, perhaps none, and facts about them.

    These are counts of rows, and of each trajectory ``[E, 3]`` the return, the length,
    and whether it is complete.
    """
    columns = _arrays(rows, options.num_actions)
    if "next_observation" in columns:  # that of a terminated row may be missing
        after, ended = columns["next_observation"], columns["terminated"] == 1
        unknown = (ended & (after != after).all(1))[:, None]
        if unknown.any():
            after = np.where(unknown, columns["observation"], after)
            columns["next_observation"] = after
    lost = _missing(columns, options.missing)
    flagged, ends = _ends(columns)
    trajectory = np.cumsum(np.r_[False, ends[:-1]])
    broken = np.isin(trajectory, trajectory[lost])  # recorded in part
    if options.missing == "episode":
        lost = broken
    resets = np.zeros_like(lost)
    if "next_observation" in columns:
        # At the reset of a vector environment no action was executed: the row begins in
        # the last state of an episode, and has a reward of 0.
        reached = columns["next_observation"][:-1]
        begun = (reached == columns["observation"][1:]).all(1) & flagged[:-1]
        resets[1:] = begun & (columns["reward"][1:] == 0) & ~lost[1:]
    ends[:-1] |= lost[1:]
    keep = ~(lost | resets)
    if not keep.all():
        columns = {name: array[keep] for name, array in columns.items()}
        flagged, ends, broken = flagged[keep], ends[keep], broken[keep]
    ends[-1:] = True
    reward = columns["reward"].astype(np.float64)
    columns = _cast(columns, options.num_actions)
    columns["action"], outside = _unit_actions(columns["action"], options)
    episode = columns.pop("episode", None)
    terminated = columns["terminated"]
    truncated = columns.get("truncated", np.zeros_like(terminated))
    stops = np.flatnonzero(ends)
    starts = np.r_[0, stops + 1][:-1]
    complete = flagged[stops] & ~broken[stops]
    if "next_observation" in columns and episode is None:
        # Rows that do not follow one another have no sum of rewards.
        pair = columns["next_observation"][:-1], columns["observation"][1:]
        same = np.isclose(*pair, SAME_STATE, SAME_STATE).all(1)
        jumps = np.r_[~same & ~ends[:-1], False]
        complete &= ~np.logical_or.reduceat(jumps, starts)
    returns = np.add.reduceat(reward, starts)
    keep = np.ones_like(ends)
    if "next_observation" not in columns:
        observation = columns["observation"]
        columns["next_observation"] = np.roll(observation, -1, axis=0)
        columns["next_observation"][terminated] = observation[terminated]
        keep = ~ends | terminated
    # Only an end is dropped: its trajectory is then cut at the row before.
    last = ends.copy()
    last[:-1] |= ~keep[1:]
    columns["truncated"] = truncated | (last & ~terminated)
    if not keep.all():
        columns = {name: column[keep] for name, column in columns.items()}
    counts = {
        "dropped_rows": int((~keep).sum()),
        "missing_rows": int(lost.sum()),
        "reset_rows": int(resets.sum()),
        "actions_outside": outside,
        "terminated_ends": int(terminated[stops].sum()),
        "truncated_ends": int((truncated & ~terminated)[stops].sum()),
        "unmarked_ends": int((~flagged)[stops].sum()),
    }
    episodes = np.c_[returns, stops - starts + 1, complete]
    return as_transitions(columns), counts, episodes


def _arrays(rows: Columns, num_actions: int | None) -> dict[str, Array]:
    """Return columns as arrays of numbers with one row a step."""
    required = ("observation", "action", "reward", "terminated")
    flaws = [f"no {name}" for name in required if name not in rows]
    if not {"truncated", "episode"} & rows.keys():
        flaws.append("neither truncated nor episode")
    # A misspelt optional column would otherwise be overlooked.
    known = {*required, "truncated", "episode", "next_observation"}
    flaws += [f"an unknown {name!r}" for name in rows if name not in known]
    if flaws:
        raise ValueError(f"the columns have {', '.join(flaws)}.")
    columns: dict[str, Array] = {}
    count = np.size(rows["reward"])
    if not count:
        raise ValueError("the data hold no rows; expected at least one transition.")
    for name, values in rows.items():
        array = np.asarray(values)
        size = np.size(array) // count
        if name == "next_observation":
            size = np.shape(rows["observation"])[-1]
        vector = name.endswith("observation") or (name, num_actions) == ("action", None)
        shapes = [(count, max(size, 1))] if vector else [(count,), (count, 1)]
        if array.shape not in shapes or array.dtype.kind not in "biuf":
            raise ValueError(
                f"{name!r} has shape {[*array.shape]} and type {array.dtype}; expected "
                f"numbers {' or '.join(str([*shape]) for shape in shapes)}."
            )
        columns[name] = array if vector else array.reshape(-1)
    return columns


def _missing(columns: Mapping[str, Array], missing: str) -> Array:
    """Return which rows ``[N]`` lack a value in some column."""
    lost = np.zeros(len(columns["reward"]), np.bool_)
    for name, array in columns.items():
        wrong = (array != array).reshape(len(array), -1).any(1)  # NaN alone
        if wrong.any() and missing == "error":
            raise ValueError(
                f"{name!r} has no value in row {wrong.argmax()} of {len(array)}, "
                f"one of {wrong.sum()}: leave out such rows or their episodes "
                "(data.missing=row, data.missing=episode)."
            )
        lost |= wrong
    return lost


def _ends(columns: Mapping[str, Array]) -> tuple[Array, Array]:
    """Return rows ``[N]`` with a flag that ends a trajectory, and all that end one."""
    flagged = np.zeros(len(columns["reward"]), np.bool_)
    for name in {"terminated", "truncated"} & columns.keys():
        flagged |= np.nan_to_num(columns[name]).astype(np.bool_)
    ends = flagged.copy()
    ends[-1] = True
    if "episode" in columns:
        given = pd.Series(columns["episode"])
        before = given.ffill()  # a number that is missing between two equal ones
        episode = before.where(before == given.bfill(), given).to_numpy()
        same = np.r_[np.diff(episode) == 0, False]
        if (wrong := flagged & same).any():
            row = int(wrong.argmax())
            raise ValueError(
                f"row {row} ends its episode, and row {row + 1} belongs to the same "
                f"'episode' {columns['episode'][row]:.15g}, as in {wrong.sum()} rows: "
                "the flags may be late, or the rows in another order."
            )
        ends |= ~same
        numbers, times = np.unique(episode[ends], return_counts=True, equal_nan=False)
        if (times > 1).any():
            raise ValueError(
                f"'episode' {numbers[times > 1][0]:.15g} comes back; expected its rows "
                "together. data.columns.step sorts them."
            )
    return flagged, ends


def _cast(columns: Mapping[str, Array], num_actions: int | None) -> dict[str, Array]:
    """Return columns of the training's types; actions may still have other bounds."""
    cast: dict[str, Array] = {}
    for name, array in columns.items():
        if name == "episode":
            _refuse(name, array, array != np.floor(array), "whole numbers")
            cast[name] = array
        elif name in ("terminated", "truncated"):
            _refuse(name, array, (array != 0) & (array != 1), "bool, or 0 and 1")
            cast[name] = array.astype(np.bool_)
        elif name == "action" and num_actions is not None:
            known = np.isin(array, range(num_actions))
            _refuse(name, array, ~known, f"discrete actions, 0 to {num_actions - 1}")
            cast[name] = np.eye(num_actions, dtype=np.float32)[array.astype(int)]
        else:
            with np.errstate(over="ignore"):
                cast[name] = array.astype(np.float32)
            _refuse(name, array, ~np.isfinite(cast[name]), "finite float32")
            if name == "action" and array.dtype != np.float32:
                cast[name] = array.astype(np.float64)  # to be mapped exactly
    return cast


def _refuse(name: str, array: Array, wrong: Array, expected: str) -> None:
    if wrong.any():
        index = tuple(np.argwhere(wrong)[0])
        raise ValueError(
            f"{name!r} holds {array[index]} in row {index[0]} of {len(array)}; "
            f"expected {expected}."
        )


def _unit_actions(action: Array, options: Reading) -> tuple[Array, int]:
    """Return actions from -1 to 1, clipped, and the number of rows outside."""
    if options.num_actions is not None:
        return action, 0
    size = action.shape[1]
    low, high = (np.asarray(b, np.float64) for b in options.action_bounds)
    fits = {low.size, high.size} <= {1, size} and np.isfinite([low.sum(), high.sum()])
    if not (np.all(fits) and (low < high).all()):
        raise ValueError(
            f"action_bounds={options.action_bounds}; expected the lowest and the "
            f"highest action, finite numbers, one or {size} each, low < high "
            "(data.action_bounds)."
        )
    low, high = (np.broadcast_to(bound, size) for bound in (low, high))
    whole = ((action >= 0) & (action == np.round(action))).all()
    alone = size == 1 or (action.sum(1) == 1).all()
    if whole and alone and (low < 0).all() and (action != action[:1]).any():
        raise ValueError(
            f"'action' holds only the whole numbers {action.min():g} to "
            f"{action.max():g}, which look like discrete actions: name the environment "
            "(env.id=...), give their number (env=none env.action_size=...), or the "
            "bounds of forces (data.action_bounds=[0,high])."
        )
    # Bounds of -1 and 1 leave the numbers as they are, bit by bit.
    same = (low == -1).all() and (high == 1).all()
    unit = action if same else (action - low) / (high - low) * 2 - 1
    unit = unit.astype(np.float32)
    outside = (np.abs(unit) > 1 + ROUNDING).any(1)
    if outside.any() and not options.clip_actions:
        row = int(outside.argmax())
        raise ValueError(
            f"'action' leaves its bounds in {outside.sum()} of {len(action)} rows, "
            f"first in row {row}: {action[row].tolist()}, where they are "
            f"{low.tolist()} and {high.tolist()}. Give the env of this log (or "
            "env=none), data.action_bounds=[low,high], or data.clip_actions=true if "
            "the environment clipped them."
        )
    return np.clip(unit, -ACTION_LIMIT, ACTION_LIMIT), int(outside.sum())
