"""Logs of your own, in a plain file: NumPy archive, HDF5 or Parquet.

All three hold the same columns; nothing is unpickled.
"""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr._files import check_unpacked_size, read_arrays
from torchrl_osr.data.read.column_checks import ActionBounds
from torchrl_osr.data.read.recording import ReadRows, Recording, whole_trajectories


def load_file(
    path: str | Path,
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    num_actions: int | None = None,
    on_disk: bool = False,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load recorded steps from a file of your own.

    Columns are those of :func:`~torchrl_osr.data.transitions_from_rows`, and nothing
    else; rows are in order of time. In an HDF5 file they are arrays at the root; in
    Parquet, ``observation``, ``action`` and ``next_observation`` are columns of lists.

    Args:
        path: ends in ``.npz`` (always read at once), ``.hdf5``, ``.h5`` or
            ``.parquet``.

    Keyword Args:
        action_bounds: see :func:`~torchrl_osr.data.transitions_from_rows`.
        clip_actions: see there.
        num_actions: of a task with discrete actions: ``action`` then holds their
            numbers from 0, ``[N]`` or ``[N, 1]``, and becomes one-hot. Default: actions
            are real.
        on_disk: see :func:`~torchrl_osr.data.load_dataset`. Default: ``False``.
        progress: show a progress bar while writing to disk. Default: ``True``.

    Returns:
        The transitions ``[N]`` and the manifest of that function, with ``reader``,
        ``source`` and ``data_sha256``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another ending, a damaged file, one that unpacks to more than both
            4 GiB and its own size, or columns that differ from the above.

    Examples:
        >>> import tempfile, numpy as np
        >>> from torchrl_osr.data import load_file
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(
        ...         f"{folder}/log.npz",
        ...         observation=np.random.rand(6, 3),
        ...         action=np.random.uniform(-1, 1, (6, 2)),
        ...         reward=np.ones(6),
        ...         terminated=np.array([0, 0, 1, 0, 0, 0]),
        ...         episode=np.array([0, 0, 0, 1, 1, 1]),
        ...     )
        ...     data, manifest = load_file(f"{folder}/log.npz")
        >>> len(data), manifest["dropped_rows"]
        (5, 1)
    """
    path = Path(path).expanduser().absolute()
    openers = {
        ".npz": _open_npz,
        ".hdf5": _open_hdf5,
        ".h5": _open_hdf5,
        ".parquet": _open_parquet,
    }
    if path.suffix not in openers:
        raise ValueError(f"{path} must end in one of {', '.join(openers)}.")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    total, read = openers[path.suffix](path)
    about = {"reader": "file", "source": str(path)}
    parts = partial(whole_trajectories, read, total)
    recording = Recording(
        parts, action_bounds, clip_actions, about, [path], total, num_actions
    )
    return recording.load(on_disk=on_disk, progress=progress)


def _open_npz(path: Path) -> tuple[int, ReadRows]:
    arrays = read_arrays(path)
    rows = max((len(array) for array in arrays.values() if array.ndim), default=0)

    def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
        return {
            name: array[start:stop] if array.ndim else array
            for name, array in arrays.items()
        }

    return rows, read


def _open_hdf5(path: Path) -> tuple[int, ReadRows]:
    from torchrl_osr.data.read.hdf5 import open_hdf5

    return open_hdf5(path)


def _open_parquet(path: Path) -> tuple[int, ReadRows]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(
            f"Parquet files need {error.name!r}: pip install torchrl-osr[minari]"
        ) from error

    @lru_cache(maxsize=1)  # the next part may begin in the last group of this one
    def group(number: int) -> Any:
        try:
            return file.read_row_group(number)
        except (pyarrow.ArrowException, OSError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error

    def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
        first = int(np.searchsorted(bounds, start, side="right")) - 1
        last = int(np.searchsorted(bounds, stop, side="left"))
        check_unpacked_size(path, sum(sizes[first:last]))
        groups = [group(number) for number in range(first, last)]
        table = pyarrow.concat_tables([file.schema_arrow.empty_table(), *groups])
        table = table.slice(start - bounds[first], stop - start)
        return {name: _as_numpy(name, table[name]) for name in table.column_names}

    try:
        file = parquet.ParquetFile(path)
        metadata = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise ValueError(f"{path} is no Parquet file, or damaged: {error}") from error
    bounds = np.cumsum([0, *(group.num_rows for group in metadata)])
    sizes = [
        8 * sum(group.column(i).num_values for i in range(group.num_columns))
        for group in metadata
    ]
    return int(bounds[-1]), read


def _as_numpy(name: str, column: Any) -> NDArray[Any]:
    """Parquet column ``[N]``, or ``[N, D]`` if it holds lists."""
    import pyarrow

    if column.null_count:
        row = int(np.flatnonzero(column.is_null())[0])
        raise ValueError(f"{name!r} has no value in row {row}.")
    kinds = pyarrow.types
    if not any(
        is_kind(column.type)
        for is_kind in (kinds.is_list, kinds.is_large_list, kinds.is_fixed_size_list)
    ):
        return np.asarray(column.to_numpy())
    lengths = column.combine_chunks().value_lengths().to_numpy(zero_copy_only=False)
    sizes, first = np.unique(lengths, return_index=True)
    if len(sizes) > 1:
        raise ValueError(
            f"{name!r} has lists of unequal length: {sizes[0]} numbers in row "
            f"{first[0]}, {sizes[1]} in row {first[1]}."
        )
    values = column.combine_chunks().flatten()
    if values.null_count:
        entry = int(np.flatnonzero(values.is_null())[0])
        raise ValueError(f"{name!r} has no value in row {entry // int(sizes[0])}.")
    flat = np.asarray(values.to_numpy(zero_copy_only=False))
    return flat.reshape(len(column), -1) if len(column) else flat.reshape(0, 1)
