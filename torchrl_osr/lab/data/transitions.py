"""Transition data sets: their keys, their check, and how recorded columns become one.

Shapes: ``N`` rows, ``E`` trajectories, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase

from torchrl_osr._checks import check_choice

VECTOR_KEYS: tuple[NestedKey, ...] = ("observation", ("next", "observation"), "action")
FLAG_KEYS: tuple[NestedKey, ...] = tuple(
    ("next", name) for name in ("done", "terminated", "truncated")
)
DATASET_KEYS: tuple[NestedKey, ...] = (*VECTOR_KEYS, ("next", "reward"), *FLAG_KEYS)
"""Keys that every transition data set of this package has."""

# A tanh-Gaussian density is needed at the data's actions, and atanh(1) is infinite;
# float32 tanh reaches exactly 1. At 0.999 the pre-tanh action is 3.8.
ACTION_LIMIT = 0.999

ROWS_AT_A_TIME = 2**20
"""Rows of a memory-mapped set that are copied at a time: 90 MB of hopper."""

# Two recordings of one state may differ by rounding, relative to its entries.
SAME_STATE = 1e-6

# A bound may be exceeded by float32 arithmetic, not by an unclipped policy.
ROUNDING = 1e-5

ActionBounds = tuple[ArrayLike, ArrayLike]
"""Lowest and highest action, numbers or ``[A]``."""

Array = NDArray[Any]
Columns = Mapping[str, Any]

REQUIRED = ("observation", "action", "reward", "terminated")
OPTIONAL = ("truncated", "episode", "next_observation")


def as_transitions(columns: Mapping[str, Array]) -> TensorDict:
    """Transitions ``[N]`` from arrays by name, which are not copied."""
    size = [len(columns["reward"])]
    tensors = {name: torch.from_numpy(array) for name, array in columns.items()}
    after = {n: tensors[n][:, None] for n in ("reward", "terminated", "truncated")}
    after["done"] = after["terminated"] | after["truncated"]
    after["observation"] = tensors["next_observation"]
    rows = {name: tensors[name] for name in ("observation", "action")}
    return TensorDict(rows | {"next": TensorDict(after, size)}, size)


def check_dataset(data: TensorDictBase) -> None:
    """Raise unless ``data``, transitions ``[N]``, can be trained on.

    Keys, shapes, types and flags must be right, all numbers finite, and observations,
    next observations and actions not zero everywhere.
    """
    check_rows(data)
    check_filled(data)


def check_rows(data: TensorDictBase) -> None:
    """Check some rows of a data set, in which a field may be zero."""
    rows = len(data) if data.ndim == 1 else 0
    for key in DATASET_KEYS:
        column = data[key]
        size = data["action" if key == "action" else "observation"].shape[-1]
        shape = [rows, size if key in VECTOR_KEYS else 1]
        dtype = torch.bool if key in FLAG_KEYS else torch.float32
        if not rows or [*column.shape] != shape or column.dtype != dtype:
            raise ValueError(
                f"{key!r} has shape {[*column.shape]} and type {column.dtype}; "
                f"expected {shape} and {dtype}, in a flat set with at least one row."
            )
        if bad := int((~torch.isfinite(column)).any(dim=-1).sum()):
            raise ValueError(f"{key!r} holds NaN or infinity in {bad} of {rows} rows.")
    done, *ends = (data[key] for key in FLAG_KEYS)
    if wrong := int((done != (ends[0] | ends[1])).sum()):
        raise ValueError(f"done differs from terminated | truncated in {wrong} rows.")


def check_filled(data: TensorDictBase) -> None:
    """Raise if one of ``VECTOR_KEYS`` is zero in all rows."""
    for key in VECTOR_KEYS:
        if not any(bool(part.any()) for part in data[key].split(ROWS_AT_A_TIME)):
            # TorchRL 0.11 to 0.14.1 does this to Minari sets.
            raise ValueError(f"{key!r} is zero in all {len(data)} rows.")


@dataclass(frozen=True)
class Reading:
    """Options for recorded columns, see :func:`transitions_from_columns`."""

    action_bounds: Any = (-1.0, 1.0)
    clip_actions: bool = False
    num_actions: int | None = None
    missing: str = "error"

    def __post_init__(self) -> None:
        check_choice("data.missing", self.missing, ("error", "row", "episode"))


class Part(NamedTuple):
    """Transitions ``[N]`` of whole trajectories, perhaps none, and facts about them.

    ``episodes`` ``[E, 3]``: return, length, and whether it is complete. ``changes``
    ``[2, S + 1]``: how often each observation and the reward change from one row to the
    next, and how many of these changes float32 loses.
    """

    data: TensorDict
    counts: dict[str, int]
    episodes: NDArray[np.float64]
    changes: NDArray[np.int64]


def trajectories(rows: Columns, options: Reading) -> Part:
    """Transitions of a part of a set, see :func:`transitions_from_columns`."""
    columns = _arrays(rows, options.num_actions)
    lost = _missing(columns, options.missing)
    flagged, ends = _ends(columns)
    trajectory = np.cumsum(np.r_[False, ends[:-1]])
    broken = np.isin(trajectory, trajectory[lost])  # recorded in part
    if options.missing == "episode":
        lost = broken
    resets = _reset_rows(columns, flagged) & ~lost
    ends[:-1] |= lost[1:]
    keep = ~(lost | resets)
    if not keep.any():
        counts = {"missing_rows": int(lost.sum()), "reset_rows": int(resets.sum())}
        return Part(TensorDict(), counts, np.empty((0, 3)), np.zeros((2, 1), int))
    if not keep.all():
        columns = {name: array[keep] for name, array in columns.items()}
        flagged, ends, broken = flagged[keep], ends[keep], broken[keep]
    ends[-1] = True
    reward = columns["reward"].astype(np.float64)
    numbers = np.c_[columns["observation"], reward]
    columns = _cast(columns, options.num_actions)
    columns["action"], clipped, outside = _unit_actions(columns["action"], options)
    moved = np.diff(numbers, axis=0) != 0
    vanished = moved & (np.diff(numbers.astype(np.float32), axis=0) == 0)
    changes = np.stack([moved.sum(0), vanished.sum(0)])

    episode = columns.pop("episode", None)
    terminated = columns["terminated"]
    truncated = columns.get("truncated", np.zeros_like(terminated))
    stops = np.flatnonzero(ends)
    starts = np.r_[0, stops[:-1] + 1]
    complete = flagged[stops] & ~broken[stops]
    if "next_observation" in columns and episode is None:
        # Rows that do not follow one another have no sum of rewards.
        reached, after = columns["next_observation"][:-1], columns["observation"][1:]
        slack = SAME_STATE * np.maximum(1, np.abs(after))
        jumps = np.r_[(np.abs(reached - after) > slack).any(1) & ~ends[:-1], False]
        complete &= ~np.logical_or.reduceat(jumps, starts)
    returns = np.add.reduceat(reward, starts)
    episodes = np.c_[returns, stops - starts + 1, complete]
    keep, filled = np.ones_like(ends), 0
    if "next_observation" not in columns:
        observation = columns["observation"]
        columns["next_observation"] = np.roll(observation, -1, axis=0)
        columns["next_observation"][terminated] = observation[terminated]
        keep, filled = ~ends | terminated, int(terminated.sum())
    # Only an end is dropped: its trajectory is then cut at the row before.
    last = ends.copy()
    last[:-1] |= ~keep[1:]
    columns["truncated"] = truncated | (last & ~terminated)
    if not keep.all():
        columns = {name: column[keep] for name, column in columns.items()}
    counts = {
        "dropped_rows": int((~keep).sum()),
        "terminal_rows_filled": filled,
        "missing_rows": int(lost.sum()),
        "reset_rows": int(resets.sum()),
        "clipped_actions": clipped,
        "actions_outside": outside,
        "terminated_ends": int(terminated[stops].sum()),
        "truncated_ends": int((truncated & ~terminated)[stops].sum()),
        "unmarked_ends": int((~flagged)[stops].sum()),
    }
    return Part(as_transitions(columns), counts, episodes, changes)


def _arrays(rows: Columns, num_actions: int | None) -> dict[str, Array]:
    """Columns as arrays of numbers with one row a step; masked entries become NaN."""
    flaws = [f"no {name}" for name in REQUIRED if name not in rows]
    if not {"truncated", "episode"} & rows.keys():
        flaws.append("neither truncated nor episode")
    # A misspelt optional column would otherwise be overlooked.
    flaws += [f"an unknown {n!r}" for n in rows if n not in REQUIRED + OPTIONAL]
    if flaws:
        raise ValueError(f"the columns have {', '.join(flaws)}.")
    columns: dict[str, Array] = {}
    count = np.size(rows["reward"])
    for name, values in rows.items():
        if np.ma.is_masked(values):
            values = np.ma.asarray(values, np.float64).filled(np.nan)
        array = np.asarray(values)
        size = int(np.size(array) / max(count, 1))
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
    if not count:
        raise ValueError("the data hold no rows; expected at least one transition.")
    return columns


def _missing(columns: Mapping[str, Array], missing: str) -> NDArray[np.bool_]:
    """Rows ``[N]`` without a value in some column."""
    lost = np.zeros(len(columns["reward"]), np.bool_)
    for name, array in columns.items():
        wrong = (array != array).reshape(len(array), -1).any(1)  # NaN alone
        if wrong.any() and missing == "error":
            raise ValueError(
                f"{name!r} has no value in row {wrong.argmax()} of {len(array)}, "
                f"one of {wrong.sum()}: repair them, or leave out such rows or their "
                "episodes (data.missing=row, data.missing=episode)."
            )
        lost |= wrong
    return lost


def _ends(columns: Mapping[str, Array]) -> tuple[Array, Array]:
    """Rows ``[N]`` whose flags end a trajectory, and all rows that end one."""
    flagged = np.zeros(len(columns["reward"]), np.bool_)
    for name in {"terminated", "truncated"} & columns.keys():
        flagged |= np.nan_to_num(columns[name]).astype(np.bool_)
    ends = flagged.copy()
    ends[-1] = True
    if "episode" in columns:
        same = np.r_[np.diff(columns["episode"]) == 0, False]
        if (wrong := flagged & same).any():
            row = int(wrong.argmax())
            raise ValueError(
                f"row {row} ends its episode, and row {row + 1} belongs to the same "
                f"'episode' {columns['episode'][row]:g}, as in {wrong.sum()} rows: the "
                "flags may be late, or the rows in another order."
            )
        ends |= ~same
        numbers, times = np.unique(columns["episode"][ends], return_counts=True)
        if (times > 1).any():
            raise ValueError(
                f"'episode' {numbers[times > 1][0]:g} comes back; expected its rows "
                "together. data.columns.step sorts them."
            )
    return flagged, ends


def _reset_rows(columns: Mapping[str, Array], flagged: Array) -> Array:
    """Rows ``[N]`` in which a vector environment was reset: no action was executed.

    They begin in the state that an episode ended in, and have a reward of 0.
    """
    if "next_observation" not in columns:
        return np.zeros_like(flagged)
    reached = np.roll(columns["next_observation"], 1, axis=0)
    same = (reached == columns["observation"]).all(1) & (columns["reward"] == 0)
    return np.asarray(same & np.r_[False, flagged[:-1]])


def _cast(columns: Mapping[str, Array], num_actions: int | None) -> dict[str, Array]:
    """Columns as they are trained on; actions may still have other bounds."""
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


def _unit_actions(action: Array, options: Reading) -> tuple[Array, int, int]:
    """Actions from -1 to 1, clipped; how many rows were, and how many outside."""
    if options.num_actions is not None:
        return action, 0, 0
    size = action.shape[1]
    low, high = (np.broadcast_to(np.float64(b), size) for b in options.action_bounds)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise ValueError(
            f"action_bounds={options.action_bounds}; expected the lowest and the "
            "highest action, finite numbers (data.action_bounds)."
        )
    whole = ((action >= 0) & (action == np.round(action))).all()
    alone = size == 1 or (action.sum(1) == 1).all()
    if whole and alone and (low < 0).all() and np.ptp(action) > 0:
        raise ValueError(
            f"'action' holds only the whole numbers {action.min():g} to "
            f"{action.max():g}, which look like discrete actions: name the environment "
            "(env.id=...), or give the bounds of forces (data.action_bounds=[0,high])."
        )
    unit = action
    # Bounds of -1 and 1 leave the numbers as they are, bit by bit.
    if np.any(low != -1) or np.any(high != 1):
        unit = (action.astype(np.float64) - low) / (high - low) * 2 - 1
    unit = unit.astype(np.float32)
    outside = (np.abs(unit) > 1 + ROUNDING).any(1)
    if outside.any() and not options.clip_actions:
        row = int(outside.argmax())
        raise ValueError(
            f"'action' leaves its bounds in {outside.sum()} of {len(action)} rows, "
            f"first in row {row}: {action[row].tolist()}, where they are "
            f"{low.tolist()} and {high.tolist()}. Give the true ones "
            "(data.action_bounds=[low,high]), or data.clip_actions=true if the "
            "environment clipped them."
        )
    clipped = np.clip(unit, -ACTION_LIMIT, ACTION_LIMIT)
    return clipped, int((clipped != unit).any(1).sum()), int(outside.sum())
