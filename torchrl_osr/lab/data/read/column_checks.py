"""Raw columns of recorded data, checked and cast: one array a column, one row a step.

Whatever deviates from the layout is an error that names the column and the first row;
nothing is guessed. Arrays of objects are refused, and nothing is unpickled.

Shapes: ``N`` rows, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_osr.lab.data.store.validation import ACTION_LIMIT

ActionBounds = tuple[ArrayLike, ArrayLike]
"""Lowest and highest action, numbers or ``[A]``."""

REQUIRED_COLUMNS = ("observation", "action", "reward", "terminated")
OPTIONAL_COLUMNS = ("truncated", "episode", "next_observation")

# What a bound may be overshot by: float32 arithmetic, not an unclipped policy.
ROUNDING = 1e-5


class Checked(NamedTuple):
    """Columns as they are trained on, and what the casts have changed.

    Attributes:
        columns: in float32, bool and whole numbers.
        clipped: rows whose action was clipped to ``ACTION_LIMIT``.
        outside: those of them whose action was outside of its bounds.
        changes: of ``observation`` and ``reward``, for each entry how often the number
            changes from one row to the next, and how often it does so no more in
            float32, ``[2, D]``.
    """

    columns: dict[str, NDArray[Any]]
    clipped: int
    outside: int
    changes: dict[str, NDArray[np.int64]]


def checked_columns(
    rows: Mapping[str, ArrayLike],
    action_bounds: ActionBounds,
    clip_actions: bool,
    num_actions: int | None = None,
) -> Checked:
    """Check and cast the columns of some steps.

    Raises:
        ValueError: a column is missing, unknown, of the wrong shape, length or type,
            or holds a value that it cannot hold.
    """
    _check_names(rows)
    columns = {name: _as_numbers(name, values) for name, values in rows.items()}
    count = len(columns["observation"]) if columns["observation"].ndim else 0
    if count == 0:
        raise ValueError("the data hold no rows; expected at least one transition.")
    for name in columns:
        _check_shape(name, columns, count, num_actions)
    clipped = outside = 0
    changes = {}
    for name, array in columns.items():
        if name == "action" and num_actions is not None:
            columns[name] = _one_hot(array.reshape(count), num_actions)
        elif name == "action":
            columns[name], clipped, outside = _unit_actions(
                array, action_bounds, clip_actions
            )
        elif name in ("observation", "next_observation", "reward"):
            array = array if name != "reward" else array.reshape(count)
            columns[name] = _as_float32(name, array)
            if name != "next_observation":
                changes[name] = _changes(array, columns[name])
        elif name == "episode":
            columns[name] = _as_whole_numbers(name, array.reshape(count))
        else:
            columns[name] = _as_flags(name, array.reshape(count))
    return Checked(columns, clipped, outside, changes)


def _check_names(rows: Mapping[str, ArrayLike]) -> None:
    known = (*REQUIRED_COLUMNS, *OPTIONAL_COLUMNS)
    layout = (
        f"expected {', '.join(REQUIRED_COLUMNS)}, truncated or episode or both, and "
        "possibly next_observation."
    )
    # A misspelt optional column would otherwise be overlooked.
    if unknown := [name for name in rows if name not in known]:
        raise ValueError(f"unknown columns {', '.join(map(repr, unknown))}; {layout}")
    missing = [name for name in REQUIRED_COLUMNS if name not in rows]
    if not {"truncated", "episode"} & set(rows):
        missing.append("truncated or episode")
    if missing:
        raise ValueError(f"the data lack {', '.join(missing)}; {layout}")


def as_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """Array of a column.

    Raises:
        ValueError: its rows are of unequal length, or entries of it are masked.
    """
    if isinstance(values, np.ma.MaskedArray) and values.mask.any():
        rows = np.atleast_2d(np.ma.getmaskarray(values).T).any(0)
        raise ValueError(
            f"{name!r} is masked in row {int(rows.argmax())} of {rows.size}, and in "
            f"{int(rows.sum())} rows: what is missing cannot be trained on; leave out "
            "these rows, or fill them in."
        )
    try:
        return np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name!r} has rows of unequal length.") from error


def _as_numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    array = as_array(name, values)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name!r} has type {array.dtype}; expected numbers.")
    return array


def _check_shape(
    name: str,
    columns: Mapping[str, NDArray[Any]],
    count: int,
    num_actions: int | None,
) -> None:
    shape = columns[name].shape
    if name == "observation" or (name == "action" and num_actions is None):
        right = len(shape) == 2 and shape[0] == count and shape[1] > 0
        expected = f"[{count}, D] with D > 0, one row for each observation."
    elif name == "next_observation":
        right = shape == columns["observation"].shape
        expected = f"that of 'observation', {list(columns['observation'].shape)}."
    else:
        right = shape in ((count,), (count, 1))
        expected = f"[{count}], one row for each observation."
    if not right:
        raise ValueError(f"{name!r} has shape {list(shape)}; expected {expected}")


def _as_float32(name: str, array: NDArray[Any]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # what is too large is told below, by its row
        cast = array.astype(np.float32)
    if not np.isfinite(cast).all():
        wrong = ~np.isfinite(cast.reshape(len(cast), -1))
        row, entry = np.argwhere(wrong)[0]
        value = array.reshape(len(array), -1)[row, entry]
        raise ValueError(
            f"{name!r} holds {value} in row {row} of {len(array)}, and something of "
            f"the kind in {int(wrong.any(1).sum())} rows; expected finite float32."
        )
    return cast


def _changes(array: NDArray[Any], cast: NDArray[np.float32]) -> NDArray[np.int64]:
    """See ``changes`` of :class:`Checked`; a column at a time, to spare memory."""
    wide = array.reshape(len(array), -1)
    found = np.zeros((2, wide.shape[1]), np.int64)
    if array.dtype.kind != "b" and array.dtype.itemsize > 2:
        for entry, narrow in enumerate(cast.reshape(wide.shape).T):
            moved = wide[1:, entry] != wide[:-1, entry]
            found[:, entry] = moved.sum(), (moved & (narrow[1:] == narrow[:-1])).sum()
    return found


def _refuse(
    name: str, array: NDArray[Any], wrong: NDArray[np.bool_], expected: str
) -> None:
    """Raise a ValueError that names the first row of those that are wrong, ``[N]``."""
    if rows := np.flatnonzero(wrong).tolist():
        raise ValueError(
            f"{name!r} holds {array[rows[0]]} in row {rows[0]} of {len(array)}; "
            f"expected {expected}."
        )


def _as_whole_numbers(name: str, array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name!r} has type {array.dtype}; expected whole numbers.")
    # What is missing, a NaN, is none either.
    _refuse(name, array, array != np.floor(array), "whole numbers")
    return array.astype(np.int64)


def _as_flags(name: str, array: NDArray[Any]) -> NDArray[np.bool_]:
    _refuse(name, array, (array != 0) & (array != 1), "bool, or 0 and 1")
    return np.asarray(array != 0)


def _one_hot(action: NDArray[Any], num_actions: int) -> NDArray[np.float32]:
    """Rows ``[N, num_actions]`` with a 1 at each action's number."""
    known = (action >= 0) & (action < num_actions) & (action == np.floor(action))
    expected = f"the number of a discrete action, from 0 to {num_actions - 1}"
    _refuse("action", action, ~known, expected)
    return np.eye(num_actions, dtype=np.float32)[action.astype(np.int64)]


def _unit_actions(
    action: NDArray[Any], bounds: ActionBounds, clip: bool
) -> tuple[NDArray[np.float32], int, int]:
    """Map ``bounds`` to -1 and 1, clip to ``ACTION_LIMIT``; count rows, see Checked."""
    low, high = check_bounds(bounds)
    if any(bound.shape not in ((), action.shape[1:]) for bound in (low, high)):
        raise ValueError(
            f"action_bounds={bounds} for {action.shape[1]} actions; expected two "
            "numbers, or two lists with a number for each action (data.action_bounds)."
        )
    low, high = (np.broadcast_to(bound, action.shape[1:]) for bound in (low, high))
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise ValueError(
            f"action bounds {low.tolist()} and {high.tolist()}; expected finite "
            "numbers, the lower first: say what they are with action_bounds=[low,high] "
            "(data.action_bounds=[low,high])."
        )
    unit = _as_float32("action", action)
    _refuse_discrete(unit, low, high)
    # Bounds of -1 and 1 shall leave the numbers alone, bit by bit.
    if np.any(low != -1) or np.any(high != 1):
        mapped = (action.astype(np.float64) - low) / (high - low) * 2 - 1
        unit = _as_float32("action", mapped)
    outside = np.flatnonzero((np.abs(unit) > 1 + ROUNDING).any(1))
    if len(outside) and not clip:
        raise ValueError(
            f"'action' leaves its bounds in {len(outside)} of {len(action)} rows, "
            f"first in row {outside[0]}: {action[outside[0]].tolist()}, where they are "
            f"{low.tolist()} and {high.tolist()}. Give the true ones with "
            "action_bounds=[low,high] (data.action_bounds=[low,high]); if the "
            "environment itself clipped what it was given, clip_actions=True "
            "(data.clip_actions=true)."
        )
    clipped = np.clip(unit, -ACTION_LIMIT, ACTION_LIMIT)
    return clipped, int((clipped != unit).any(1).sum()), len(outside)


def check_bounds(bounds: ActionBounds) -> tuple[NDArray[Any], NDArray[Any]]:
    """Lowest and highest action as arrays, if they are such; not whether they fit."""
    try:
        low, high = (np.asarray(bound, np.float64) for bound in bounds)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"action_bounds={bounds}; expected the lowest and the highest action: two "
            "numbers, or two lists with a number for each action (data.action_bounds)."
        ) from error
    return low, high


def _refuse_discrete(
    action: NDArray[np.float32], low: NDArray[Any], high: NDArray[Any]
) -> None:
    """Raise if numbers of discrete actions, or one-hot rows, were taken for forces."""
    whole = bool(((action >= 0) & (action == np.round(action))).all())
    alone = action.shape[1] == 1 or bool((action.sum(1) == 1).all())
    if whole and alone and (low < 0).all() and np.ptp(action) > 0:
        raise ValueError(
            f"'action' holds only the whole numbers {action.min():g} to "
            f"{action.max():g}, where its bounds are {low.tolist()} and "
            f"{high.tolist()}: they look like numbers of discrete actions, which a "
            "loss for continuous ones would take for forces. Of discrete actions give "
            "the number, num_actions= (env.id=... of their task); of forces the "
            "bounds, action_bounds=[0,high] (data.action_bounds=[0,high])."
        )
