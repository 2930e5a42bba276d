"""Which columns of a file are the observation, the action and the rest of a log.

Columns are those that the user names, or those that have the names that logs usually
have. A vector is one array ``[N, D]``, or one column for each of its entries.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.lab.data.read.recording import ReadRows

USUAL_NAMES = {
    "observation": ("observation", "observations", "obs", "state", "states"),
    "action": ("action", "actions", "act"),
    "reward": ("reward", "rewards"),
    "terminated": ("terminated", "terminal", "terminals"),
    "truncated": ("truncated", "timeout", "timeouts"),
    "episode": ("episode", "episode_id"),
    "step": (),
    "next_observation": (
        *("next_observation", "next_observations", "next_obs"),
        *("next_state", "next_states"),
    ),
}
"""What a log is made of, and what these columns are called unless the user says it."""

VECTORS = ("observation", "action", "next_observation")

ColumnNames = Mapping[str, str | Sequence[str] | bool | None]
"""Names or patterns (``obs_*``) of columns, by the keys of ``USUAL_NAMES``.

``None`` stands for the usual names; ``terminated=False`` for a task that nothing ends.
"""


class Table(NamedTuple):
    """A file with named columns.

    Attributes:
        names: of all columns, in the file's order.
        select: gives the number of rows of some of them, and what reads those.
    """

    names: list[str]
    select: Callable[[list[str]], tuple[int, ReadRows]]


class Layout(NamedTuple):
    """Where a table has what a log is made of.

    Attributes:
        columns: names of the columns, by what they are.
        unused: names of those that are not read.
    """

    columns: dict[str, list[str]]
    unused: list[str]


def find_columns(names: Sequence[str], wanted: ColumnNames) -> Layout:
    """Find the parts of a log among the columns of a file.

    Args:
        names: of the file's columns.
        wanted: what the user names. If that is nothing, all columns must be known.

    Raises:
        ValueError: a named column is not there, or is read twice; a column or an entry
            of a vector is missing, or a column is not known.
    """
    if unknown := wanted.keys() - USUAL_NAMES.keys():
        raise ValueError(
            f"columns has no entry {', '.join(sorted(unknown))}; it has "
            f"{', '.join(USUAL_NAMES)}."
        )
    wanted = {part: each for part, each in wanted.items() if each is not None}
    named = {
        part: _named(part, each, names)
        for part, each in wanted.items()
        if not (part == "terminated" and each is False)
    }
    free = [name for name in names if all(name not in each for each in named.values())]
    usual = {part: _usual(part, free) for part in USUAL_NAMES if part not in wanted}
    found = named | usual
    columns = {part: found[part] for part in USUAL_NAMES if found.get(part)}
    parts = [(part, name) for part, each in columns.items() for name in each]
    used = [name for _, name in parts]
    if twice := [name for name in used if used.count(name) > 1]:
        where = " and ".join(part for part, name in parts if name == twice[0])
        raise ValueError(f"column {twice[0]!r} is named for {where}; expected once.")
    unused = [name for name in names if name not in used]
    _check_complete(columns, wanted, unused, names)
    if unused and not wanted:
        # A misspelt next_observation would otherwise cost rows.
        raise ValueError(
            f"unknown columns {', '.join(map(repr, unused))}: rename or remove them, "
            "or name those that shall be read (data.columns.observation=..., see "
            "docs/your_data.md); the others are then left out."
        )
    return Layout(columns, unused)


def assemble(
    layout: Layout, arrays: Mapping[str, NDArray[Any]], episodes: dict[str, int]
) -> dict[str, NDArray[Any]]:
    """Columns of a log, from those of a file.

    Args:
        layout: of the file.
        arrays: all columns of the layout, by their names in the file.
        episodes: number of each episode that is called by a text; new ones are added.

    Raises:
        ValueError: a column holds text or a single value, or is longer or shorter than
            another.
    """
    columns: dict[str, NDArray[Any]] = {}
    for part, names in layout.columns.items():
        parts = [arrays[name] for name in names]
        for name, array in zip(names, parts, strict=True):
            if not array.ndim:
                raise ValueError(f"{name!r} is one value; expected one for each row.")
        if part == "episode" and parts[0].dtype.kind in "OSU":
            texts = parts[0].astype(str) if parts[0].dtype.kind == "S" else parts[0]
            _refuse_nameless(names[0], texts)
            numbers = [episodes.setdefault(str(each), len(episodes)) for each in texts]
            columns[part] = np.array(numbers, np.int64)
            continue
        for name, array in zip(names, parts, strict=True):
            _refuse_text(name, array)
            if array.shape[:1] != parts[0].shape[:1]:
                raise ValueError(
                    f"{names[0]!r} has shape {list(parts[0].shape)}, {name!r} "
                    f"{list(array.shape)}; expected equally many rows."
                )
        several = len(parts) > 1 or (part in VECTORS and parts[0].ndim == 1)
        columns[part] = np.column_stack(parts) if several else parts[0]
    if "terminated" not in columns:
        columns["terminated"] = np.zeros(len(columns["reward"]), np.bool_)
    return columns


def _refuse_nameless(name: str, episodes: NDArray[Any]) -> None:
    """Raise where an episode has no name: it would be joined to others of that kind."""
    # None, NaN and "": of these alone, NaN is not itself.
    nameless = [each is None or each != each or each == "" for each in episodes]
    if any(nameless):
        raise ValueError(
            f"{name!r} has no value in {sum(nameless)} rows, the first of them "
            f"{nameless.index(True)} of those just read: give each row its episode."
        )


def _named(
    part: str, patterns: str | Sequence[str] | bool | None, names: Sequence[str]
) -> list[str]:
    """Columns that the user has named, in that order."""
    given = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(given, Sequence) or not all(isinstance(p, str) for p in given):
        raise ValueError(
            f"columns.{part}={patterns!r} (data.columns.{part}); expected the name of "
            "a column, or a list of names."
        )
    found: list[str] = []
    for pattern in given:
        # A name that happens to look like a pattern is a name.
        if pattern in names:
            found.append(pattern)
            continue
        matching = [name for name in names if fnmatchcase(name, pattern)]
        if not matching:
            raise ValueError(
                f"there is no column {pattern!r}, named for {part}; the file has "
                f"{_listed(names)}."
            )
        found += _in_order(part, matching)
    if part not in VECTORS and len(found) != 1:
        raise ValueError(
            f"columns.{part}={patterns!r} (data.columns.{part}) names {len(found)} "
            "columns; expected one."
        )
    return found


def _usual(part: str, names: Sequence[str]) -> list[str]:
    """Columns that have a usual name, or begin with one: ``obs_0``, ``obs_x``."""
    for usual in USUAL_NAMES[part]:
        if usual in names:
            return [usual]
    if part in VECTORS:
        for usual in USUAL_NAMES[part]:
            if found := [name for name in names if name.startswith(f"{usual}_")]:
                return _in_order(part, found)
    return []


def _in_order(part: str, names: list[str]) -> list[str]:
    """Entries of a vector by their numbers if all have one, else as in the file."""
    ends = {name: re.search(r"\d+\D?$", name) for name in names}
    stems = {name[: end.start()] if end else None for name, end in ends.items()}
    if None in stems or len(stems) > 1:
        return names
    numbers = {name: int(re.findall(r"\d+", name)[-1]) for name in names}
    ordered, there = sorted(names, key=numbers.__getitem__), sorted(numbers.values())
    # Numbers begin with 0 or 1.
    for before, number in pairwise([min(there[0] - 1, 0), *there]):
        if number > before + 1:
            raise ValueError(
                f"{part} has the columns {_listed(ordered)}, but none with the number "
                f"{before + 1}: name those that it is made of (data.columns.{part}="
                "[...]) if that is right."
            )
    return ordered


def _check_complete(
    columns: Mapping[str, list[str]],
    wanted: ColumnNames,
    unused: Sequence[str],
    names: Sequence[str],
) -> None:
    missing = [
        part for part in ("observation", "action", "reward") if part not in columns
    ]
    if "terminated" not in columns and wanted.get("terminated") is not False:
        missing.append("terminated")
    if not {"truncated", "episode"} & columns.keys():
        missing.append("truncated or episode")
    if missing:
        first = missing[0].split()[0]
        cure = f"say which they are, as in data.columns.{first}=<name>"
        if done := [name for name in unused if name.lower() in ("done", "dones")]:
            cure = (
                f"{done[0]!r} does not say whether the task ended (data.columns."
                f"terminated={done[0]}) or only the recording (data.columns.truncated="
                f"{done[0]} data.columns.terminated=false)"
            )
        elif first == "terminated":
            cure += ", or data.columns.terminated=false if nothing ends the task"
        raise ValueError(
            f"the data lack {', '.join(missing)}; the file has {_listed(names)}: "
            f"{cure}."
        )
    if "step" in columns and "episode" not in columns:
        raise ValueError(
            "columns.step (data.columns.step) sorts the rows of each episode, and no "
            "column says which they are: name it as data.columns.episode=..."
        )


def _refuse_text(name: str, array: NDArray[Any]) -> None:
    if array.dtype.kind not in "OU":
        return
    for row, value in enumerate(array.tolist()):
        try:
            missing = float(value) != float(value)
        except (TypeError, ValueError):
            raise ValueError(
                f"{name!r} holds {value!r} in row {row} of {len(array)}; expected "
                "numbers."
            ) from None
        if missing:
            raise ValueError(
                f"{name!r} has no value in row {row} of {len(array)}: repair or remove "
                "it."
            )


def _listed(names: Sequence[str], most: int = 20) -> str:
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest if names else "no columns"
