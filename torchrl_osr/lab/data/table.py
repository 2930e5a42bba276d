"""Logs of your own as tables: CSV, Parquet, HDF5 or NumPy archives."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from glob import glob
from itertools import chain, takewhile
from pathlib import Path
from typing import IO, Any

import numpy as np

from torchrl_osr._checks import needed_by
from torchrl_osr._files import read_arrays
from torchrl_osr.lab.data.columns import NO_REWARDS, Reading, convert, has_rewards
from torchrl_osr.lab.data.store import Dataset
from torchrl_osr.lab.data.transitions import Array

with needed_by("tables need", "train"):
    import pandas as pd

Arrays = dict[str, Array]

STATES = "observation", "observations", "obs", "state", "states"
USUAL_NAMES = {
    "observation": STATES,
    "action": ("action", "actions", "act"),
    "reward": ("reward", "rewards"),
    "terminated": ("terminated", "terminal", "terminals"),
    "truncated": ("truncated", "timeout", "timeouts"),
    "episode": ("episode", "episode_id"),
    "step": (),
    "next_observation": tuple(f"next_{name}" for name in STATES),
}
"""Parts of a log, and what their columns are called unless you name them."""

VECTORS = ("observation", "action", "next_observation")

NUMBER = re.compile(r"[-+]?\d*[.,]?\d+(e[-+]?\d+)?", re.IGNORECASE)


def read_log(
    path: str | Path | Sequence[str],
    columns: Mapping[str, Any],
    options: Reading,
    source: str = "file",
) -> Dataset:
    """Return transitions of a log and their manifest; ``columns`` names its parts."""
    files = log_files(path)
    paths = [str(file) for file in files]
    about = {"source": source, "path": paths[0] if len(paths) == 1 else paths}
    return convert(log_parts(files, columns, about), options, about, files)


def log_files(path: str | Path | Sequence[str]) -> list[Path]:
    """Return the files of a name, a pattern or a list of both."""
    files: list[Path] = []
    for each in [path] if isinstance(path, (str, Path)) else path:
        whole = Path(each).expanduser().absolute()
        there = sorted(glob(str(whole), recursive=True))
        # A name that looks like a pattern is a name.
        found = [whole] if whole.is_file() else [*map(Path, there)]
        files += found
        if not found:
            cure = "give its place (data.path=..., evaluate-offline --data ...)"
            raise FileNotFoundError(f"there is no file {whole}: {cure}")
    return [*{each.resolve(): each for each in files}.values()]  # of links, one


def log_parts(
    files: Sequence[Path], columns: Mapping[str, Any], about: dict[str, Any]
) -> Iterator[tuple[str, Arrays]]:
    """Yield the place and columns of each file; put what was found into ``about``."""

    def chosen(names: list[str], **known: str) -> list[str]:
        """Return the columns to read by name; all files need those of the first."""
        about.update(known)
        if "columns" not in about:
            about["columns"] = find_columns(names, columns)
            if not has_rewards(about):
                about.setdefault("warnings", []).append(NO_REWARDS)
        needed = [*chain(*about["columns"].values())]
        about.setdefault("unused_columns", [n for n in names if n not in needed])
        if lacking := {*needed} - {*names}:
            raise ValueError(f"it lacks {sorted(lacking)}, which other files have.")
        return needed

    for file in files:
        try:
            arrays = _read(file, chosen)
            rows = assemble(about["columns"], arrays)
            del arrays  # of other types: as large as the rows
            if not len(rows["action"]):
                raise ValueError("it holds no rows; expected at least one transition.")
            if step := about["columns"].get("step"):
                rows = _sorted(rows, step[0], about)
        except (EOFError, OSError, ValueError, zlib.error) as error:
            raise ValueError(f"{file}: {error}") from error
        yield f"{file}: ", rows


def _read(path: Path, chosen: Callable[..., list[str]]) -> Arrays:
    """Return the columns of a file that ``chosen`` selects from its names."""
    if path.suffix == ".npz":
        arrays = read_arrays(path)
        return {name: arrays[name] for name in chosen([*arrays])}
    if path.suffix in (".hdf5", ".h5"):
        with needed_by("HDF5 files need", "minari"):
            import h5py
        with h5py.File(path, "r") as file:
            names = [n for n, each in file.items() if isinstance(each, h5py.Dataset)]
            return {name: np.asarray(file[name]) for name in chosen(names)}
    if path.suffix == ".parquet":
        with needed_by("Parquet files need", "minari"):
            from pyarrow import ArrowException, parquet
        try:
            there = parquet.read_schema(path).names  # and pandas' row numbers
            names = chosen([n for n in there if not n.startswith("__index_level_")])
            table = parquet.read_table(path, columns=names)
            frame = table.to_pandas(ignore_metadata=True)
        except ArrowException as error:
            raise ValueError(
                f"the file is damaged or cut short ({error}): copy it again, or have "
                "its writer finish it (LeRobot: dataset.finalize())."
            ) from error
    elif path.suffix in (".csv", ".gz"):
        frame, text = _read_csv(path)
        names = chosen([*frame], text=text)
    else:
        raise ValueError("its name must end in .csv, .csv.gz, .parquet, .hdf5 or .npz")
    return {name: frame[name].to_numpy() for name in names}


def _read_csv(path: Path) -> tuple[pd.DataFrame, str]:
    """Return the table of a CSV file, and what was detected."""
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rb") as file:
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    for encoding in ("UTF-16" if wide else "UTF-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError), opened(path, "rt", encoding=encoding) as it:
            frame, marks = _parsed(it)
            return frame, f"{marks}, {encoding.removesuffix('-sig')}"
    raise ValueError("its text is neither UTF-8, nor UTF-16, nor cp1252.")


def _parsed(file: IO[str]) -> tuple[pd.DataFrame, str]:
    lines = file.read(2**20).splitlines()
    skipped = len([*takewhile(lambda line: line[:1] in ("", "#"), lines)])
    if skipped and NUMBER.match("".join(lines[skipped : skipped + 1])):
        skipped -= 1  # NumPy writes the names as a comment
    header, *rest = lines[skipped:] or [""]
    separator = next((each for each in ";\t|" if each in header), ",")
    (cells,) = csv.reader([header], delimiter=separator)
    names = [name.strip(" #") for name in cells]
    twice = [name for name in names if name and names.count(name) > 1]
    numeric = [name for name in names if NUMBER.fullmatch(name)]
    if {*numeric} & {*twice} or not all(map(str.isdigit, numeric)):
        raise ValueError(
            "the first line holds numbers; expected names of columns: add a header "
            "line, such as obs_0,obs_1,action,reward,terminated,episode."
        )
    if twice:
        raise ValueError(f"two columns are named {twice[0]!r}: rename one.")
    values = [each.strip(' "') for line in rest for each in line.split(separator)]
    numbers = [each for each in values if NUMBER.fullmatch(each)]
    points, commas = ([each for each in numbers if mark in each] for mark in ".,")
    if points and commas:
        raise ValueError(
            f"a point and a comma are decimal marks, in {points[0]} and {commas[0]}: "
            "write all numbers alike, without separators of thousands."
        )
    decimal = "," if commas else "."
    file.seek(0)
    options: Any = {"skipinitialspace": True, "low_memory": False, "decimal": decimal}
    frame = pd.read_csv(file, sep=separator, skiprows=skipped, **options)
    if not isinstance(frame.index, pd.RangeIndex):
        raise ValueError(
            "lines have more values than the header has names, or end with a separator."
        )
    named = [name for name in frame if not name.startswith("Unnamed: ")]
    frame = frame[named].rename(columns=lambda name: name.strip(" #"))
    filled = np.flatnonzero(frame.notna().any(axis=1))
    frame = frame[: filled.max(initial=-1) + 1]  # not a spreadsheet's empty end
    return frame, f"separator {separator!r}, decimal {decimal!r}"


def find_columns(
    names: Sequence[str], wanted: Mapping[str, Any]
) -> dict[str, list[str]]:
    """Return each part's columns by name; without ``wanted``, all must be known."""
    if unknown := wanted.keys() - USUAL_NAMES.keys():
        raise ValueError(
            f"data.columns has no {', '.join(unknown)}, only {', '.join(USUAL_NAMES)}."
        )
    endless = wanted.get("terminated") is False
    given = {part: each for part, each in wanted.items() if each or type(each) is int}
    found = {part: _named(part, each, names) for part, each in given.items()}
    free = [name for name in names if name not in {*chain(*found.values())}]
    for part in (part for part in USUAL_NAMES if part not in wanted):
        after = [f"next_{name}" for name in found.get("observation", ())]
        paired = part == "next_observation" and after and {*after} <= {*free}
        found[part] = after if paired else _usual(part, free)
    columns = {part: found[part] for part in USUAL_NAMES if found.get(part)}
    used = [*chain(*columns.values())]
    if twice := [name for name in used if used.count(name) > 1]:
        raise ValueError(f"column {twice[0]!r} is read twice: {columns}.")
    required = ["observation", "action"] + ["terminated"] * (not endless)
    missing = [part for part in required if part not in columns]
    if "episode" not in columns and ("step" in columns or "truncated" not in columns):
        missing.append("episode" if "step" in columns else "truncated or episode")
    if missing:
        part = missing[0].split()[0]
        cure = f"name it with data.columns.{part}=<name> (data=file or data=lerobot)"
        if missing[0] == "terminated":
            cure += ", or data.columns.terminated=false if nothing ends the task"
        elif part == "truncated":
            cure += "; a column with the number of the episode is enough"
        raise ValueError(
            f"the data lack {', '.join(missing)}; there are {', '.join(names)}: {cure}."
        )
    unused = [name for name in names if name not in used]
    if unused and not wanted:
        # A misspelt next_observation would otherwise cost rows.
        raise ValueError(
            f"unknown columns {', '.join(unused)}: rename, remove, or name those to "
            "read (data.columns.observation=...)."
        )
    return columns


def _named(part: str, patterns: Any, names: Sequence[str]) -> list[str]:
    """Return the columns that the user has named, in that order."""
    found: list[str] = []
    listed = isinstance(patterns, (list, tuple))
    for pattern in map(str, patterns if listed else [patterns]):
        # A name that looks like a pattern is a name.
        exact = [pattern] * (pattern in names)
        matching = exact or _in_order([n for n in names if fnmatchcase(n, pattern)])
        found += matching
        if not matching or (part not in VECTORS and len(found) > 1):
            given, number = (patterns, len(found)) if matching else (pattern, 0)
            raise ValueError(
                f"data.columns.{part}={given} names {number} columns; there are "
                f"{', '.join(names)}."
            )
    return found


def _usual(part: str, names: Sequence[str]) -> list[str]:
    """Return columns with a usual name, or a usual start: ``obs_0``, ``obs_x``."""
    for usual in USUAL_NAMES[part]:
        if usual in names:
            return [usual]
    starts = USUAL_NAMES[part] if part in VECTORS else ()
    found = ([n for n in names if n.startswith(f"{usual}_")] for usual in starts)
    return _in_order(next(filter(None, found), []))


def _in_order(names: list[str]) -> list[str]:
    """Sort the entries of a vector by number if all have one, else as in the file.

    A gap in the numbers is an error: an entry may be missing.
    """
    matches = [re.fullmatch(r"(.*?)(\d+)\D?", name) for name in names]
    found = [match for match in matches if match]
    numbered = {int(match[2]): match[0] for match in found}
    if len(numbered) < len(names) or len({match[1] for match in found}) != 1:
        return names
    first, last = min(numbered), max(numbered)
    if gaps := sorted({*range(1 if first else 0, last)} - numbered.keys()):
        raise ValueError(
            f"{numbered[first]} to {numbered[last]} lack number {gaps[0]}: if that is "
            "right, list the columns to read (data.columns.<part>=[...])."
        )
    return [numbered[number] for number in sorted(numbered)]


def assemble(layout: Mapping[str, list[str]], arrays: Arrays) -> Arrays:
    """Return the columns of a log, from those of a file."""
    columns: Arrays = {}
    for part, names in layout.items():
        first = arrays[names[0]].reshape(-1)
        if part not in ("step", "episode"):
            found = [_numbers(name, arrays[name]) for name in names]
            vector = len(found) > 1 or (part in VECTORS and found[0].ndim == 1)
            columns[part] = np.column_stack(found) if vector else found[0]
        elif part == "step" or first.dtype.kind in "biuf":
            columns[part] = first
        else:  # names, numbered in order of appearance
            numbers = pd.factorize(first)[0].astype(np.float64)
            columns[part] = np.where(numbers < 0, np.nan, numbers)
    rows = len(columns["action"])
    columns.setdefault("reward", np.zeros(rows))  # see has_rewards
    columns.setdefault("terminated", np.zeros(rows, np.bool_))
    return columns


def _numbers(name: str, array: Array) -> Array:
    """Return a column of numbers, with NaN for missing values."""
    if array.dtype.kind in "biuf":
        return array
    try:
        lists = [each for each in array if isinstance(each, np.ndarray)]
        if lists:  # of one length
            none = np.full(lists[0].shape, np.nan)
            return np.stack([none if each is None else each for each in array])
        numbers = pd.to_numeric(pd.Series([*array], dtype=object))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name!r} holds other than numbers: {error}.") from error
    return np.asarray(numbers, np.float64)


def _sorted(columns: Arrays, name: str, about: dict[str, Any]) -> Arrays:
    """Sort the rows of each episode by its steps or time stamps."""
    given, episode = columns.pop("step"), columns["episode"]
    step, unit = given, ""
    if {*map(len, columns.values())} != {len(episode)}:
        return columns  # which is refused
    if given.dtype.kind not in "biuf":
        try:
            times = pd.to_datetime(given, format="ISO8601", utc=True)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{name!r} holds {given[0]}; expected numbers, or time stamps such as "
                "2026-03-29T10:00:00.02."
            ) from error
        step, unit = np.asarray((times - times[0]).total_seconds()), " s"
    if not np.isfinite(step).all():
        row = int((~np.isfinite(step)).argmax())
        raise ValueError(f"{name!r} is empty in row {row} of {len(step)}: fill it in.")
    order = np.lexsort((step, episode))
    rows = {key: each[order] for key, each in columns.items()}
    same, gaps = np.diff(episode[order]) == 0, np.diff(step[order]).astype(float)
    if not same.any():
        return rows
    usual = np.sort(gaps[same])[same.sum() // 2]
    uneven = abs(gaps - usual) > usual / 2
    steps = f"{name}, {usual:.2g}{unit} apart"  # clocks jitter
    if unit and usual:
        steps += f" ({1 / usual:.2g} a second)"
    wrong, warnings = same & ((gaps == 0) | uneven), about.setdefault("warnings", [])
    if wrong.any():
        row = int(wrong.argmax())
        found = (
            f"episode {rows['episode'][row]:.15g} goes from {name!r} "
            f"{given[order[row]]} to {given[order[row + 1]]}, where steps are {usual:g}"
            f"{unit} apart, as in {wrong.sum()} places: rows are missing or double, or "
            "the rate changes."
        )
        if (same & (gaps == 0)).any() or "next_observation" not in columns:
            cure = "Resample to one rate, start new episodes, or give next_observation."
            raise ValueError(f"{found} {cure}")
        warnings.append(found)
    if about.setdefault("steps", steps) != steps:
        warnings.append(f"steps are {about['steps']}, and in another file {steps}.")
    return rows
