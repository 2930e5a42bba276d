"""Recorded data in a file, read in slices of whole trajectories: HDF5 and Parquet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.data.columns import ActionBounds
from torchrl_osr.data.file_reader import as_numpy
from torchrl_osr.data.slices import Slices, whole_trajectories

ReadRows = Callable[[int, int], dict[str, NDArray[Any]]]

# A slice of 200,000 longer rows would not fit in memory.
MAX_ROW_BYTES = 2**14

# A row group is unpacked as a whole; pyarrow's default, a million rows, has 250 MB of
# hopper.
MAX_GROUP_BYTES = 2**29


def slices_of_file(
    path: str | Path,
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
) -> Slices:
    """Open a file of your own for reading in slices.

    The rows are those of :func:`~torchrl_osr.data.load_file`.

    Args:
        path: ends in ``.hdf5``, ``.h5`` or ``.parquet``. A NumPy archive cannot be read
            in slices.

    Keyword Args:
        action_bounds: see :func:`~torchrl_osr.data.transitions_from_rows`.
        clip_actions: see there.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another ending, a damaged file, or columns of unequal length.
    """
    path = Path(path).expanduser()
    openers = {".hdf5": open_hdf5, ".h5": open_hdf5, ".parquet": open_parquet}
    if path.suffix not in openers:
        raise ValueError(
            f"{path} cannot be read slice by slice, which data.storage=disk does: it "
            f"must end in one of {', '.join(openers)}. Store it as one of them, or "
            "take data.storage=memory."
        )
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    total, read = openers[path.suffix](path)
    return Slices(
        {"source": str(path)},
        total,
        partial(whole_trajectories, read, total),
        action_bounds,
        clip_actions,
    )


def open_hdf5(path: Path, names: Iterable[str] | None = None) -> tuple[int, ReadRows]:
    """Return the number of rows of an HDF5 file, and what reads some of them.

    Args:
        path: the file.
        names: which arrays to read if they are there. Default: all.

    Raises:
        ValueError: it is no HDF5 file or damaged, a name is no array of this file, or
            the arrays are of unequal length.
    """
    import h5py

    def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
        try:
            with h5py.File(path, "r") as file:
                return {name: file[name][start:stop] for name in lengths}
        except (OSError, KeyError, RuntimeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error

    try:
        with h5py.File(path, "r") as file:
            chosen = [n for n in file if n in set(names)] if names else list(file)
            lengths = {name: _length(path, file, name) for name in chosen}
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} is no HDF5 file, or damaged: {error}") from error
    return _one_length(path, lengths), read


def _length(path: Path, file: Any, name: str) -> int:
    """Return the number of rows of an array, if it is one and in this file."""
    import h5py

    if isinstance(file.get(name, getlink=True), h5py.ExternalLink):
        raise ValueError(f"{path}: {name!r} leads into another file.")
    array = file[name]
    if not isinstance(array, h5py.Dataset) or not array.ndim:
        raise ValueError(f"{path}: {name!r} is no array with rows; expected one.")
    if array.external or array.is_virtual:
        raise ValueError(f"{path}: {name!r} leads into another file.")
    if len(array) and array.nbytes // len(array) > MAX_ROW_BYTES:
        raise ValueError(
            f"{path}: a row of {name!r} has {array.nbytes // len(array):,} bytes; at "
            f"most {MAX_ROW_BYTES:,} are read."
        )
    return len(array)


def _one_length(path: Path, lengths: Mapping[str, int]) -> int:
    if len(set(lengths.values())) > 1:
        raise ValueError(f"{path} has columns of unequal length: {dict(lengths)}.")
    return max(lengths.values(), default=0)


def open_parquet(path: Path) -> tuple[int, ReadRows]:
    """Return the number of rows of a Parquet file, and what reads some of them.

    Raises:
        ValueError: it is no Parquet file or damaged, or has a row group that is too
            large.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(
            f"Parquet files need {error.name!r}: pip install torchrl-osr[minari]"
        ) from error

    def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
        first, last = np.searchsorted(bounds, (start, stop - 1), side="right") - 1
        wanted = range(first, last + 1)
        for number in [number for number in groups if number not in wanted]:
            del groups[number]
        for number in wanted:
            if number not in groups:
                groups[number] = file.read_row_group(number)
        table = pyarrow.concat_tables([groups[number] for number in wanted])
        table = table.slice(start - bounds[first], stop - start)
        return {name: as_numpy(name, table[name]) for name in table.column_names}

    groups: dict[int, Any] = {}  # of the slice before: the next may begin in its last
    try:
        file = parquet.ParquetFile(path)
        metadata = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise ValueError(f"{path} is no Parquet file, or damaged: {error}") from error
    sizes = [group.num_rows for group in metadata]
    for group in metadata:
        columns = [group.column(i) for i in range(group.num_columns)]
        size = 8 * sum(column.num_values for column in columns)
        if size > MAX_GROUP_BYTES:
            raise ValueError(
                f"{path} has a row group of {group.num_rows:,} rows and about {size:,} "
                f"bytes, which is read at once; at most {MAX_GROUP_BYTES:,} are: write "
                "it with a smaller row_group_size."
            )
    bounds = np.cumsum([0, *sizes])
    return int(bounds[-1]), read
