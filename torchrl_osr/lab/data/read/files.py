"""Logs of your own, in a plain file: CSV, Parquet, HDF5 or a NumPy archive.

All of them are tables of named columns; nothing is unpickled.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr._files import read_arrays
from torchrl_osr.lab.data.read.column_checks import ActionBounds
from torchrl_osr.lab.data.read.recording import (
    Columns,
    ReadRows,
    Recording,
    naming,
    whole_trajectories,
)
from torchrl_osr.lab.data.read.table import ColumnNames, Table, assemble, find_columns

ENDINGS = (".csv", ".csv.gz", ".parquet", ".hdf5", ".h5", ".npz")


def load_file(
    path: str | Path,
    *,
    columns: ColumnNames | None = None,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    num_actions: int | None = None,
    on_disk: bool = False,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load recorded steps from a file of your own.

    A row is a step. A column is an array ``[N]`` or ``[N, D]``: at the root of an HDF5
    file or archive, of numbers or of lists in Parquet, of numbers in CSV, whose first
    line has the names.

    Args:
        path: ends in ``.csv``, ``.csv.gz``, ``.parquet``, ``.hdf5``, ``.h5`` or
            ``.npz``; the last is always read at once.

    Keyword Args:
        columns: names of the file's columns by what they are: ``observation``,
            ``action``, ``reward``, ``terminated``, ``truncated``, ``episode``,
            ``next_observation``, as in
            :func:`~torchrl_osr.lab.data.transitions_from_rows`, and ``step``, by which
            the
            rows of an episode are sorted. Names may be patterns (``"obs_*"``), and of
            vectors lists of names, one for each entry. ``terminated=False`` says that
            nothing ends the task. Episodes may be called by texts. Default: the usual
            names, such as ``observation``, ``obs`` or ``obs_0``, ``obs_1``, ...; then
            a column that is not known is an error, otherwise it is left out.
        action_bounds: see :func:`~torchrl_osr.lab.data.transitions_from_rows`.
        clip_actions: see there.
        num_actions: of a task with discrete actions: ``action`` then holds their
            numbers from 0, ``[N]`` or ``[N, 1]``, and becomes one-hot. Default: actions
            are real.
        on_disk: see :func:`~torchrl_osr.lab.data.load_dataset`. Default: ``False``.
        progress: show a progress bar while writing to disk. Default: ``True``.

    Returns:
        The transitions ``[N]`` and the manifest of that function, with ``reader``,
        ``source``, ``data_sha256``, ``columns`` (names by what they are) and
        ``unused_columns``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another ending, a damaged file, one that unpacks to more than both
            4 GiB and its own size, columns that are missing, doubled or not known, or
            what :func:`~torchrl_osr.lab.data.transitions_from_rows` refuses.

    Examples:
        >>> import tempfile, numpy as np
        >>> from torchrl_osr.lab.data import load_file
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
    return open_file(
        path,
        columns=columns,
        action_bounds=action_bounds,
        clip_actions=clip_actions,
        num_actions=num_actions,
    ).load(on_disk=on_disk, progress=progress)


def open_file(
    path: str | Path,
    *,
    columns: ColumnNames | None = None,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    num_actions: int | None = None,
) -> Recording:
    """Open a file, see :func:`load_file`; of its rows none is read yet."""
    path = Path(path).expanduser().absolute()
    if not path.name.endswith(ENDINGS):
        raise ValueError(f"{path} must end in one of {', '.join(ENDINGS)}.")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: give the path of a log.")
    table = _open_table(path)
    with naming(str(path)):
        layout = find_columns(table.names, columns or {})
    named = [name for each in layout.columns.values() for name in each]
    total, read_columns = table.select(named)
    episodes: dict[str, int] = {}

    def read_log(start: int, stop: int) -> Columns:
        return assemble(layout, read_columns(start, stop), episodes)

    read: ReadRows = read_log

    about = {
        "reader": "file",
        "source": str(path),
        "columns": layout.columns,
        "unused_columns": layout.unused,
    }
    if "step" in layout.columns:
        with naming(str(path)):
            read = _sorted(read_log(0, total), layout.columns["step"][0])
    parts = partial(whole_trajectories, read, total)
    return Recording(
        parts, action_bounds, clip_actions, about, [path], total, num_actions
    )


def _open_table(path: Path) -> Table:
    # Each kind needs a library of its own, and only the one that is asked for.
    if path.suffix == ".npz":
        return _open_npz(path)
    if path.suffix == ".parquet":
        from torchrl_osr.lab.data.read.parquet_table import open_parquet

        return open_parquet(path)
    if path.suffix in (".hdf5", ".h5"):
        from torchrl_osr.lab.data.read.hdf5 import open_hdf5

        return open_hdf5(path)
    from torchrl_osr.lab.data.read.csv_table import open_csv

    return open_csv(path)


def _open_npz(path: Path) -> Table:
    arrays = read_arrays(path)

    def select(chosen: list[str]) -> tuple[int, ReadRows]:
        tall = [len(arrays[name]) for name in chosen if arrays[name].ndim]

        def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
            return {
                name: arrays[name][start:stop] if arrays[name].ndim else arrays[name]
                for name in chosen
            }

        return max(tall, default=0), read

    return Table([*arrays], select)


def _sorted(columns: Columns, name: str) -> ReadRows:
    """Rows of all episodes, each in order of its steps.

    Raises:
        ValueError: an episode has a step twice, or lacks one that its next state would
            be read from.
    """
    lengths = {key: each.shape[:1] for key, each in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns have {lengths} rows; expected equally many.")
    step, episode = (columns[key].reshape(-1) for key in ("step", "episode"))
    if wrong := np.flatnonzero(~np.isfinite(step)).tolist():
        raise ValueError(f"{name!r} has no number in row {wrong[0]} of {len(step)}.")
    order = np.lexsort((step, episode))
    rows = {key: each[order] for key, each in columns.items() if key != "step"}
    same = np.diff(episode[order]) == 0
    between = np.diff(step[order])
    if wrong := np.flatnonzero(same & (between == 0)).tolist():
        raise ValueError(
            f"episode {rows['episode'][wrong[0]]} has {name!r} "
            f"{step[order][wrong[0]]} twice; expected each step once."
        )
    if "next_observation" not in columns and step.dtype.kind in "iu" and same.any():
        sizes, counts = np.unique(between[same], return_counts=True)
        usual = sizes[counts.argmax()]
        if wrong := np.flatnonzero(same & (between != usual)).tolist():
            raise ValueError(
                f"episode {rows['episode'][wrong[0]]} goes from {name!r} "
                f"{step[order][wrong[0]]} to {step[order][wrong[0] + 1]}, where steps "
                f"are {usual} apart: a next state is missing. Give next_observation, "
                "or another episode to what follows."
            )
    return lambda start, stop: {key: each[start:stop] for key, each in rows.items()}
