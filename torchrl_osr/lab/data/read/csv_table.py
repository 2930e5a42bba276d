"""CSV files, plain or compressed by gzip, read in parts from front to back."""

from __future__ import annotations

import csv
import gzip
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr._extras import needed_by
from torchrl_osr._files import check_unpacked_size
from torchrl_osr.lab.data.read.recording import ReadRows
from torchrl_osr.lab.data.read.table import Table

with needed_by("CSV files need", "train"):
    import pandas as pd

ROWS_AT_A_TIME = 100_000
BLOCK = 2**20


def open_csv(path: Path) -> Table:
    """Columns of a CSV file whose first line names them.

    Raises:
        ValueError: it is no such file or damaged, two columns have one name, or it
            unpacks to more than both 4 GiB and its own size.
    """
    names = _names(path)

    def select(chosen: list[str]) -> tuple[int, ReadRows]:
        # All columns: asked for some, pandas overlooks lines that are too long.
        rows, kinds = 0, {name: set[str]() for name in chosen}
        for part in _frames(path, names, names):
            rows += len(part)
            for name in chosen:
                text = pd.api.types.is_string_dtype(part[name])
                kinds[name].add("text" if text else part[name].dtype.kind)
        # pandas infers types part by part: 007 is 7 where all others are numbers, too.
        texts = [name for name in chosen if {"text", "i"} <= kinds[name]]
        return rows, _reader(path, names, chosen, rows, texts)

    return Table(names, select)


def _names(path: Path) -> list[str]:
    try:
        if path.suffix == ".gz":
            _check_size(path)
        opened = gzip.open if path.suffix == ".gz" else open
        with opened(path, "rt", encoding="utf-8-sig", newline="") as file:
            names = next(csv.reader([file.readline(BLOCK)]), [])
    except (EOFError, OSError, UnicodeError, csv.Error, zlib.error) as error:
        raise ValueError(
            f"{path} is no CSV file, or damaged: {error}. Take a whole copy of it."
        ) from error
    names = [name.strip() for name in names]
    if len(names) < 2:
        raise ValueError(
            f"{path} is no CSV file, or damaged: its first line holds {names}; "
            "expected the names of at least two columns, separated by commas."
        )
    if not all(names):
        raise ValueError(
            f"{path}: column {names.index('') + 1} has no name. pandas writes one "
            "unless index=False, and a comma at the end of the first line makes one: "
            "name it or remove it."
        )
    if any(name.replace(".", "").lstrip("-").isdigit() for name in names):
        raise ValueError(
            f"{path}: the first line holds numbers, {', '.join(names[:3])}, ...; "
            "expected the names of the columns."
        )
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{path}: two columns are called {twice[0]!r}; rename one.")
    return names


def _check_size(path: Path) -> None:
    """Raise if a small file unpacks to a great many bytes; nothing is kept of them."""
    unpacked = 0
    with gzip.open(path) as file:
        while block := file.read(BLOCK):
            unpacked += len(block)
            check_unpacked_size(path, unpacked)


def _frames(
    path: Path, names: list[str], chosen: list[str], texts: Sequence[str] = ()
) -> Iterator[pd.DataFrame]:
    """Parts of some columns, and ``texts`` of these as they are written."""
    try:
        with warnings.catch_warnings():
            # pandas drops what a line has beyond the header, with a warning.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            yield from pd.read_csv(
                path,
                chunksize=ROWS_AT_A_TIME,
                header=0,
                names=names,
                usecols=chosen if chosen != names else None,
                dtype=dict.fromkeys(texts, str),
                index_col=False,
                encoding="utf-8-sig",
                low_memory=False,
            )
    except (
        *(EOFError, OSError, UnicodeError, zlib.error),
        *(pd.errors.ParserError, pd.errors.EmptyDataError, pd.errors.ParserWarning),
    ) as error:
        raise ValueError(
            f"{path} is no CSV file, or damaged: {error}. Take a whole copy of it."
        ) from error


def _reader(
    path: Path, names: list[str], chosen: list[str], rows: int, texts: Sequence[str]
) -> ReadRows:
    """What reads rows; to go back is to begin anew."""
    nothing = pd.DataFrame({name: np.empty(0) for name in chosen})
    frames, part, first = iter([nothing]), nothing, rows

    def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
        nonlocal frames, part, first
        check_unpacked_size(path, 8 * len(chosen) * (stop - start))
        if start < first:
            frames, part, first = _frames(path, names, chosen, texts), nothing, 0
        parts, end = [part], first + len(part)
        while end < stop:
            parts.append(next(frames))
            end += len(parts[-1])
        whole = pd.concat([each for each in parts if len(each)] or parts[:1])
        part, first = whole.iloc[start - first :], start
        head = part.iloc[: stop - start]
        return {name: head[name].to_numpy() for name in chosen}

    return read
