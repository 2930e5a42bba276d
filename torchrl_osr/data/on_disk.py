"""A data set larger than memory: rows are read from disk as they are drawn.

A folder with ``rows.bin``, records of one size (:mod:`torchrl_osr.data.records`), and
``manifest.json``. Nothing is unpickled, and no name in the manifest is opened.

As many rows as a budget of memory takes are held, the others are read with ``pread``.
The file is not mapped: pages of a mapped file count as this process's memory, and a
fault may map 2 MB of the page cache for a row of 100 bytes; to drop them often enough
took longer than to read. Nor does a file that becomes shorter or unreadable end the
process with a signal; it is an error with a name.

Shapes: ``N`` rows, ``B`` batch, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

import copy
import os
from itertools import repeat
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from torchrl_osr._files import read_text
from torchrl_osr.data.manifest import unsealed
from torchrl_osr.data.records import RecordLayout

ROWS, MANIFEST = "rows.bin", "manifest.json"

# Raise it whenever the records or what the manifest must have change.
FORMAT_VERSION = 1

# Longer vectors would be a damaged manifest: humanoid, the widest of Gymnasium's tasks,
# has 348 entries.
MAX_ENTRIES = 2**16


# A training run then has 1.4 GiB altogether. Of hopper, these are 8 million rows.
HELD_BYTES = 896 * 2**20


class _File:
    """A file that is open as long as it is of use to a set, or to parts of one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.number = os.open(path, os.O_RDONLY)

    def __del__(self) -> None:
        os.close(self.number)


class TransitionsOnDisk:
    """Transitions in a file; a row is read when it is asked for.

    Each row that is read is checked against its checksum. The whole file is not, so
    that opening takes no time: ``sha256sum rows.bin`` and the manifest's ``sha256``
    compare it.

    Args:
        folder: what :func:`~torchrl_osr.data.write_on_disk` has written.

    Attributes:
        manifest: what is known of the data.

    Raises:
        FileNotFoundError: there is no such set.
        ValueError: the manifest is damaged or of another format, or the file has not
            the size that it says.

    Examples:
        >>> import tempfile, torch
        >>> from torchrl_osr.data import load_local_dataset, write_on_disk
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     data, _ = load_local_dataset(
        ...         "hopper", "random", num_transitions=500, cache_dir=folder
        ...     )
        ...     stored = write_on_disk(lambda done: [(data, {})], f"{folder}/set")
        ...     rows = stored[torch.tensor([3, 1, 3])]
        >>> bool((rows == data[torch.tensor([3, 1, 3])]).all())
        True
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / ROWS
        if not (self.folder / MANIFEST).is_file() or not path.is_file():
            raise FileNotFoundError(
                f"{self.folder} holds no {ROWS} with a {MANIFEST}: expected a folder "
                "that write_on_disk has written."
            )
        try:
            self.manifest = unsealed(read_text(self.folder / MANIFEST), MANIFEST)
            self.layout = _layout(self.manifest)
        except ValueError as error:
            raise ValueError(f"{self.folder}: {error}.") from error
        self._rows = self._total = int(self.manifest["num_transitions"])
        self._held = np.empty(0, f"V{self.layout.dtype.itemsize}")
        self._shifts: Tensor | None = None
        self._file = _File(path)
        expected = self._rows * self.layout.dtype.itemsize
        if (size := os.fstat(self._file.number).st_size) != expected:
            raise ValueError(
                f"{path} has {size:,} bytes; {self._rows:,} rows have {expected:,}: it "
                "is damaged or was not copied whole. Delete the folder and write it "
                "again."
            )

    def __len__(self) -> int:
        """Return the number of rows ``N``."""
        return self._rows

    def __getitem__(self, index: Tensor) -> TensorDict:
        """Read rows.

        Args:
            index: row numbers ``[B]``, from 0 on.

        Returns:
            Transitions ``[B]``, on the CPU.

        Raises:
            IndexError: there is no such row.
            ValueError: a row is damaged.
            OSError: the file cannot be read.
        """
        if not isinstance(index, Tensor) or index.ndim != 1:
            raise IndexError(f"{index!r}: expected row numbers, a tensor [B].")
        rows = index.numpy(force=True)
        if len(rows) and not (rows.min() >= 0 and rows.max() < self._rows):
            raise IndexError(
                f"rows {rows.min()} to {rows.max()} were asked for; there are "
                f"{self._rows}, counted from 0."
            )
        if self._shifts is not None:
            index = torch.from_numpy(rows)
            shifts = torch.searchsorted(self._shifts, index, right=True)
            rows = (index + shifts).numpy()
        try:
            return self.layout.unpack(self._read(rows))
        except ValueError as error:
            if len(error.args) == 1:
                raise
            raise ValueError(
                f"{self._file.path} is damaged: {error.args[0]}, row "
                f"{rows[error.args[1]]:,}. Delete {self.folder} and write it again."
            ) from error

    def _read(self, rows: NDArray[np.int64]) -> NDArray[np.void]:
        """Return the records of rows, from memory or from the file."""
        size, held = self.layout.dtype.itemsize, len(self._held)
        records = np.empty(len(rows), f"V{size}")
        if held:
            self._held.take(rows, out=records, mode="clip")  # of others, any
        far = np.flatnonzero(rows >= held)
        offsets = (rows[far] * size).tolist()
        # Row by row; a comprehension would be slower.
        read = map(os.pread, repeat(self._file.number), repeat(size), offsets)
        content = b"".join(read)
        if len(content) != len(far) * size:
            raise ValueError(f"{self._file.path} has become shorter: write it again.")
        records[far] = np.frombuffer(content, records.dtype)
        return records

    @property
    def held(self) -> int:
        """Number of rows that are held in memory."""
        return len(self._held)

    def hold(self, max_bytes: int = HELD_BYTES) -> None:
        """Read the first rows into memory, where they are drawn from much faster.

        Args:
            max_bytes: of memory. Default: 896 MiB.
        """
        size = self.layout.dtype.itemsize
        held = np.empty(min(self._total, max_bytes // size), f"V{size}")
        view, done = held.view(np.uint8).data, 0
        while done < len(view):
            got = os.preadv(self._file.number, [view[done:]], done)
            if not got:
                raise ValueError(f"{self._file.path} has become shorter.")
            done += got
        self._held = held

    def without(self, rows: Tensor) -> TransitionsOnDisk:
        """Return the same set without some rows; nothing is copied.

        Args:
            rows: their numbers, sorted and each of them once.
        """
        if self._shifts is not None:
            raise ValueError("rows are left out already; begin with the whole set.")
        rest = copy.copy(self)
        rest._rows = self._rows - len(rows)
        # Before row i of the rest lie as many of the left-out ones as have no more than
        # i rows of the rest before them.
        rest._shifts = rows - torch.arange(len(rows))
        return rest

    def observation_moments(self) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation ``[S]`` of all observations, float64."""
        moments = self.manifest["observation"]
        mean, std = (
            torch.tensor(moments[name], dtype=torch.float64) for name in ("mean", "std")
        )
        return mean, std

    def reward_range(self) -> tuple[float, float]:
        """Return the lowest and the highest reward of all rows."""
        reward = self.manifest["reward"]
        return reward["min"], reward["max"]


def observations(data: TensorDict | TransitionsOnDisk, most: int = 200_000) -> Tensor:
    """Return the observations ``[N, S]``, of a set on disk at most so many, at random.

    Args:
        data: transitions ``[N]``.
        most: rows of a set on disk. Default: 200,000.
    """
    if isinstance(data, TransitionsOnDisk):
        order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
        data = data[order[:most].sort().values]
    observation: Tensor = data["observation"]
    return observation


def _layout(manifest: dict[str, Any]) -> RecordLayout:
    """Return the layout of the rows; raise unless the manifest is whole."""
    if manifest.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"its format_version is {manifest.get('format_version')!r}; this version "
            f"reads {FORMAT_VERSION}"
        )
    for name, most in (
        ("num_transitions", 2**48),
        ("observation_size", MAX_ENTRIES),
        ("action_size", MAX_ENTRIES),
    ):
        value = manifest.get(name)
        if type(value) is not int or not 0 < value <= most:
            raise ValueError(
                f"{name} of its {MANIFEST} is {value!r}; expected a number from 1 on"
            )
    layout = RecordLayout(manifest["observation_size"], manifest["action_size"])
    numbers = {
        ("observation", "mean"): layout.observation_size,
        ("observation", "std"): layout.observation_size,
        ("reward", "min"): 1,
        ("reward", "max"): 1,
    }
    for (column, name), size in numbers.items():
        of_column = manifest.get(column)
        values = of_column.get(name) if isinstance(of_column, dict) else None
        values = values if isinstance(values, list) else [values]
        finite = [type(value) is float and isfinite(value) for value in values]
        if len(values) != size or not all(finite):
            raise ValueError(
                f"its {MANIFEST} has no {name} of the {column}: expected {size} numbers"
            )
    return layout
