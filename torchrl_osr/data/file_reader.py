"""Logs of your own, in a plain file: NumPy archive, HDF5 or Parquet.

All three hold the same columns; nothing is unpickled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import MAGIC_PREFIX
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr._files import read_arrays, refuse_size
from torchrl_osr.data.columns import ActionBounds
from torchrl_osr.data.manifest import sha256_of
from torchrl_osr.data.trajectories import transitions_from_rows


def load_file(
    path: str | Path,
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load recorded steps from a file of your own.

    Columns: ``observation`` ``[N, S]``, ``action`` ``[N, A]``, ``reward`` ``[N]``,
    ``terminated`` ``[N]``, then ``truncated`` ``[N]`` or ``episode`` ``[N]`` (whole
    numbers) or both, and possibly ``next_observation`` ``[N, S]``; nothing else. Rows
    are in order of time. In an HDF5 file they are arrays at the root; in Parquet,
    ``observation``, ``action`` and ``next_observation`` are columns of lists.

    Args:
        path: ends in ``.npz``, ``.hdf5``, ``.h5`` or ``.parquet``.

    Keyword Args:
        action_bounds: see :func:`~torchrl_osr.data.transitions_from_rows`.
        clip_actions: see there.

    Returns:
        The transitions ``[N]`` and the manifest of that function, with ``source`` and
        ``data_sha256``.

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
    path = Path(path).expanduser()
    readers = {
        ".npz": _read_npz,
        ".hdf5": _read_hdf5,
        ".h5": _read_hdf5,
        ".parquet": _read_parquet,
    }
    if path.suffix not in readers:
        raise ValueError(f"{path} must end in one of {', '.join(readers)}.")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    rows = readers[path.suffix](path)
    data, manifest = transitions_from_rows(
        rows, action_bounds=action_bounds, clip_actions=clip_actions
    )
    return data, {"source": str(path), "data_sha256": sha256_of(path)} | manifest


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC_PREFIX)) == MAGIC_PREFIX:
                raise ValueError("it is a single array")
            return read_arrays(file)
    except (ValueError, OSError) as error:
        raise ValueError(
            f"{path} is no NumPy archive of plain arrays, or damaged: {error}"
        ) from error


def _read_hdf5(path: Path) -> dict[str, NDArray[Any]]:
    from torchrl_osr.data.hdf5 import read_hdf5

    return read_hdf5(path)


def _read_parquet(path: Path) -> dict[str, NDArray[Any]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(
            f"Parquet files need {error.name!r}: pip install torchrl-osr[minari]"
        ) from error
    try:
        refuse_size(path.stat().st_size, 8 * _count_values(parquet.ParquetFile(path)))
        # The file alone: not the columns that names of its folders might stand for.
        table = parquet.read_table(path, partitioning=None)
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise ValueError(f"{path} is no Parquet file, or damaged: {error}") from error
    return {name: as_numpy(name, table[name]) for name in table.column_names}


def _count_values(file: Any) -> int:
    """Return how many values a Parquet file announces, in all columns together."""
    groups = (file.metadata.row_group(i) for i in range(file.num_row_groups))
    return sum(
        group.column(i).num_values for group in groups for i in range(group.num_columns)
    )


def as_numpy(name: str, column: Any) -> NDArray[Any]:
    """Return a Parquet column ``[N]``, or ``[N, D]`` if it holds lists."""
    import pyarrow

    if column.null_count:
        row = int(np.flatnonzero(column.is_null())[0])
        raise ValueError(f"{name!r} has no value in row {row}.")
    kind = column.type
    if not any(
        test(kind)
        for test in (
            pyarrow.types.is_list,
            pyarrow.types.is_large_list,
            pyarrow.types.is_fixed_size_list,
        )
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
