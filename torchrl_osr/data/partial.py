"""What a collection has so far, on disk: one that is killed goes on from there.

A folder of parts, each a NumPy archive with the rows since the part before and with
how to go on. No row is written twice, so that a part costs the same however many there
are. Its ZIP checksums tell a whole part from a damaged one.

Shapes: ``N`` transitions of the whole set, ``P`` of one part.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torchrl import torchrl_logger

from torchrl_osr._files import read_arrays

# Five to ten seconds of work, and six megabytes of hopper.
SAVE_EVERY = 50_000


class Progress(NamedTuple):
    """Where a collection stands, between two episodes.

    Attributes:
        rows: transitions that are there, from the first one on.
        generator: state of the policy's NumPy bit generator.
        returns: undiscounted returns of the complete episodes.
        lengths: their steps.
    """

    rows: int
    generator: dict[str, Any]
    returns: list[float]
    lengths: list[int]


class PartialCollection:
    """The parts of one collection, in a folder that nobody else writes to.

    Args:
        folder: of the parts; made with the first.
        request: JSON-compatible, what decides the data; parts of another request are
            not used.
        save_every: rows of a part, at least. Default: 50,000.
    """

    def __init__(
        self, folder: Path, request: Mapping[str, Any], save_every: int = SAVE_EVERY
    ) -> None:
        self.folder = folder
        self.request = json.loads(json.dumps(request))  # as a part's: it has no tuples
        self.save_every = save_every
        self._parts = self._rows = self._episodes = 0

    def restore(self, columns: Mapping[str, NDArray[Any]]) -> Progress | None:
        """Fill the columns with what is there.

        Parts of another request and damaged ones are named in a warning and removed.

        Args:
            columns: ``[N, D]`` each; their first rows are written.

        Returns:
            Where to go on, ``None`` at the beginning.
        """
        progress = None
        try:
            for path in sorted(self.folder.glob("*.npz")):
                progress = self._read(path, columns, progress)
        except (OSError, KeyError, TypeError, ValueError) as flaw:
            torchrl_logger.warning(
                f"Not continuing the collection in {path}: {flaw}. Starting over."
            )
            progress = None
            self.remove()
            for column in columns.values():
                column.fill(0)  # of the flags, only those that are set are written
        return progress

    def save_if_due(
        self, columns: Mapping[str, NDArray[Any]], progress: Progress
    ) -> None:
        """Write one more part if enough rows have come since the last one.

        Args:
            columns: ``[N, D]`` each.
            progress: what there is of them, and how to go on.

        Raises:
            OSError: the part cannot be written; those before it are kept.
        """
        if progress.rows - self._rows < self.save_every:
            return
        state = progress._asdict() | {
            "request": self.request,
            "returns": progress.returns[self._episodes :],
            "lengths": progress.lengths[self._episodes :],
        }
        rows = slice(self._rows, progress.rows)
        arrays = {name: column[rows] for name, column in columns.items()}
        text = np.frombuffer(json.dumps(state).encode(), np.uint8)
        path = self.folder / f"{self._parts:06d}.npz"
        beside = path.with_name(f".{path.name}.new")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with beside.open("wb") as file:
                np.savez(file, allow_pickle=False, state=text, **arrays)
                file.flush()
                os.fsync(file.fileno())
            os.replace(beside, path)
        except OSError as error:
            beside.unlink(missing_ok=True)
            raise OSError(
                error.errno,
                f"cannot write a part of the data set ({error.strerror}); with space "
                f"for it, the same call goes on from row {self._rows:,}",
                str(path),
            ) from error
        self._count(progress)

    def remove(self) -> None:
        """Remove all parts and forget them."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._parts = self._rows = self._episodes = 0

    def _count(self, progress: Progress) -> None:
        self._parts += 1
        self._rows, self._episodes = progress.rows, len(progress.returns)

    def _read(
        self,
        path: Path,
        columns: Mapping[str, NDArray[Any]],
        before: Progress | None,
    ) -> Progress:
        """Take over one part; raise, with the reason, if it does not fit."""
        if path.name != f"{self._parts:06d}.npz":
            raise ValueError("a part before it is missing")
        with path.open("rb") as file:
            arrays = read_arrays(file, max_bytes=0)  # written without compression
        state = json.loads(arrays.pop("state").tobytes())
        there = state.pop("request")
        for key, wanted in self.request.items():
            if there.get(key) != wanted:
                raise ValueError(f"its {key} is {there.get(key)!r}, wanted {wanted!r}")
        progress = Progress(**state)
        for name, column in columns.items():
            rows = column[self._rows : progress.rows]
            if arrays[name].shape != rows.shape:
                raise ValueError(f"its {name} has shape {arrays[name].shape}")
            rows[:] = arrays[name]
        if before is not None:
            progress = progress._replace(
                returns=before.returns + progress.returns,
                lengths=before.lengths + progress.lengths,
            )
        self._count(progress)
        return progress
