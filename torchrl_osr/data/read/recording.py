"""A recorded set that is open: what all readers have in common.

A reader yields raw columns, some whole trajectories at a time. What is made of a row
depends on its trajectory alone, hence the transitions are the same whether a set is
read into memory at once or written to disk in chunks.

Shapes: ``N`` transitions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr._files import sha256_of
from torchrl_osr.data.read.column_checks import ActionBounds
from torchrl_osr.data.read.transitions import none_left, transitions_of
from torchrl_osr.data.store.statistics import describe_episodes
from torchrl_osr.data.store.validation import ACTION_LIMIT, check_dataset

Columns = Mapping[str, NDArray[Any]]
ReadRows = Callable[[int, int], Columns]
"""Columns of the rows from one number up to another."""

# Some ten megabytes of hopper.
CHUNK_ROWS = 200_000

# A trajectory is in memory as a whole; without an end in so many rows, the flags are
# more likely to be missing.
MAX_TRAJECTORY = 2_000_000


class Recording(NamedTuple):
    """A recorded set that can be read in parts.

    Attributes:
        about: what the manifest says of the source.
        files: what is read.
        total: rows of the source.
        parts: yields columns of whole trajectories, about so many rows at a time.
        action_bounds, clip_actions: see
            :func:`~torchrl_osr.data.transitions_from_rows`.
    """

    about: dict[str, Any]
    files: list[Path]
    total: int
    parts: Callable[[int], Iterator[Columns]]
    action_bounds: ActionBounds = (-1.0, 1.0)
    clip_actions: bool = False

    def load(self) -> tuple[TensorDict, dict[str, Any]]:
        """Transitions ``[N]`` in memory, and their manifest.

        Raises:
            ValueError: what :func:`~torchrl_osr.data.transitions_from_rows` raises.
        """
        conversion = Conversion(self)
        (data,) = conversion.chunks(max(self.total, 1))
        check_dataset(data)
        return data, {"num_transitions": len(data)} | conversion.manifest()


class Conversion:
    """Transitions of a recorded set, and what has been counted on the way.

    Args:
        recording: the set.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._counts: dict[str, int] = {}
        self._returns: list[float] = []
        self._lengths: list[int] = []

    def chunks(self, rows: int = CHUNK_ROWS) -> Iterator[TensorDict]:
        """Yield transitions of whole trajectories.

        Args:
            rows: of the source, about so many at a time. Default: 200,000.

        Raises:
            ValueError: what :func:`~torchrl_osr.data.transitions_from_rows` raises; row
                numbers count from the beginning of the chunk that is named.
        """
        done, kept = 0, 0
        seen: set[int] = set()
        last: list[int] = []
        for columns in self.recording.parts(rows):
            try:
                part = transitions_of(
                    columns,
                    action_bounds=self.recording.action_bounds,
                    clip_actions=self.recording.clip_actions,
                )
                episode = np.asarray(columns.get("episode", [])).ravel()
                numbers = set(np.unique(episode).tolist())
                if last == episode[:1].tolist():  # it goes on after a flag within it
                    seen -= set(last)
                if again := seen & numbers:
                    raise ValueError(
                        f"'episode' {min(again)} comes back; expected the rows of an "
                        "episode together, in order of time."
                    )
            except ValueError as error:
                where = f"in the rows from {done:,} on: " if done else ""
                raise ValueError(f"{where}{error}") from error
            seen |= numbers
            last = episode[-1:].tolist()
            done += len(columns["reward"])
            kept += len(part.data)
            for name, count in part.counts.items():
                self._counts[name] = self._counts.get(name, 0) + count
            self._returns += part.returns
            self._lengths += part.lengths
            if len(part.data):
                yield part.data
        if not kept:
            raise ValueError(none_left(done))

    def manifest(self) -> dict[str, Any]:
        """What is known of the transitions, once all have been read."""
        files = self.recording.files
        single = {"data_sha256": sha256_of(files[0])} if len(files) == 1 else {}
        return {
            **self.recording.about,
            **single,
            **self._counts,
            "action_limit": ACTION_LIMIT,
            **describe_episodes(self._returns, self._lengths),
        }


def whole_trajectories(read: ReadRows, total: int, rows: int) -> Iterator[Columns]:
    """Yield parts that end where a trajectory ends.

    Args:
        read: returns the columns of rows from one number up to another.
        total: number of rows.
        rows: of a part; more, if one trajectory has more.

    Raises:
        ValueError: a trajectory has no end within ``MAX_TRAJECTORY`` rows.
    """
    start = 0
    while start < max(total, 1):
        length, end = rows, 0
        while not end:
            stop = min(start + length, total)
            columns = read(start, stop)
            if not total or len({column.shape[:1] for column in columns.values()}) > 1:
                yield columns  # whoever checks them says what is wrong
                return
            end = stop - start if stop == total else _last_end(columns)
            if not end and length > MAX_TRAJECTORY:
                raise ValueError(
                    f"the trajectory that begins in row {start:,} has no end within "
                    f"{length:,} rows; one must fit in memory: mark ends as truncated, "
                    "or take data.storage=memory."
                )
            length *= 2
        yield {name: column[:end] for name, column in columns.items()}
        start += end


def _last_end(columns: Columns) -> int:
    """Number of rows up to the last known end of a trajectory."""
    count = len(columns["reward"]) if "reward" in columns else 0
    ends = np.zeros(count, np.bool_)
    for name in ("terminated", "truncated"):
        if name in columns:
            ends |= columns[name].reshape(count, -1).astype(np.bool_).any(1)
    if "episode" in columns:
        episode = columns["episode"].reshape(count, -1)
        ends[:-1] |= (episode[1:] != episode[:-1]).any(1)
    return int(ends.nonzero()[0][-1]) + 1 if ends.any() else 0
