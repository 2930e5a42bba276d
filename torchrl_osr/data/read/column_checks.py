"""Raw columns of recorded data, checked and cast: one array a column, one row a step.

Whatever deviates from the layout is an error that names the column and the first row;
nothing is guessed. Arrays of objects are refused, and nothing is unpickled.

Shapes: ``N`` rows, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_osr.data.store.validation import ACTION_LIMIT

ActionBounds = tuple[ArrayLike, ArrayLike]
"""Lowest and highest action, numbers or ``[A]``."""

REQUIRED_COLUMNS = ("observation", "action", "reward", "terminated")
OPTIONAL_COLUMNS = ("truncated", "episode", "next_observation")

# What a bound may be overshot by: float32 arithmetic, not an unclipped policy.
ROUNDING = 1e-5


def checked_columns(
    rows: Mapping[str, ArrayLike], *, action_bounds: ActionBounds, clip_actions: bool
) -> tuple[dict[str, NDArray[Any]], int]:
    """Columns in float32, bool and int64, and the number of clipped actions.

    Args:
        rows: the columns, see :func:`~torchrl_osr.data.transitions_from_rows`.

    Keyword Args:
        action_bounds: as there.
        clip_actions: as there.

    Raises:
        ValueError: a column is missing, unknown, of the wrong shape, length or type,
            or holds a value that it cannot hold.
    """
    _check_names(rows)
    arrays = {name: _as_array(name, values) for name, values in rows.items()}
    count = len(arrays["observation"]) if arrays["observation"].ndim else 0
    if count == 0:
        raise ValueError("the data hold no rows; expected at least one transition.")
    columns: dict[str, NDArray[Any]] = {}
    for name in ("observation", "next_observation", "action"):
        if name in arrays:
            _check_shape(name, arrays[name], count, vector=True)
            columns[name] = arrays[name]
    for name in ("reward", "terminated", "truncated", "episode"):
        if name in arrays:
            _check_shape(name, arrays[name], count, vector=False)
            columns[name] = arrays[name].reshape(count)
    if (next_observation := columns.get("next_observation")) is not None:
        expected = columns["observation"].shape
        if next_observation.shape != expected:
            raise ValueError(
                f"'next_observation' has shape {list(next_observation.shape)}; "
                f"expected that of 'observation', {list(expected)}."
            )
    for name in ("observation", "next_observation", "reward"):
        if name in columns:
            columns[name] = _as_float32(name, columns[name])
    for name in ("terminated", "truncated"):
        if name in columns:
            columns[name] = _as_flags(name, columns[name])
    if "episode" in columns and columns["episode"].dtype.kind not in "iu":
        kind = columns["episode"].dtype
        raise ValueError(f"'episode' has type {kind}; expected whole numbers.")
    columns["action"], clipped = _unit_actions(
        columns["action"], action_bounds, clip_actions
    )
    return columns, clipped


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


def _as_array(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name!r} has rows of unequal length.") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name!r} has type {array.dtype}; expected numbers.")
    return array


def _check_shape(name: str, array: NDArray[Any], count: int, *, vector: bool) -> None:
    if vector:
        right = array.ndim == 2 and len(array) == count and array.shape[1] > 0
    else:
        right = array.shape in ((count,), (count, 1))
    if not right:
        expected = f"[{count}, D] with D > 0" if vector else f"[{count}]"
        raise ValueError(
            f"{name!r} has shape {list(array.shape)}; expected {expected}, one row "
            "for each observation."
        )


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


def _as_flags(name: str, array: NDArray[Any]) -> NDArray[np.bool_]:
    wrong = np.flatnonzero((array != 0) & (array != 1))
    if len(wrong):
        raise ValueError(
            f"{name!r} holds {array[wrong[0]]} in row {wrong[0]} of {len(array)}; "
            "expected bool, or 0 and 1."
        )
    return np.asarray(array != 0)


def _unit_actions(
    action: NDArray[Any], bounds: ActionBounds, clip: bool
) -> tuple[NDArray[np.float32], int]:
    """Map ``bounds`` to -1 and 1, clip to ``ACTION_LIMIT``, count the clipped rows."""
    size = action.shape[1]
    try:
        low, high = (np.broadcast_to(np.asarray(b, np.float64), size) for b in bounds)
    except ValueError as error:
        raise ValueError(f"action_bounds={bounds} for {size} actions.") from error
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise ValueError(
            f"action bounds {low.tolist()} and {high.tolist()}; expected finite "
            "numbers, the lower first: say what they are with action_bounds=(low, high)"
        )
    unit = _as_float32("action", action)
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
            "action_bounds=(low, high); if the environment itself clipped what it was "
            "given, clip_actions=True."
        )
    clipped = np.clip(unit, -ACTION_LIMIT, ACTION_LIMIT)
    return clipped, int((clipped != unit).any(1).sum())
