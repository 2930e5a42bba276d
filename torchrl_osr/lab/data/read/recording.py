"""A recorded set that is open: what all readers have in common.

A reader yields raw columns, some whole trajectories at a time. What is made of a row
depends on its trajectory alone, hence the transitions are the same whether a set is
read into memory at once or written to disk in chunks.

Shapes: ``N`` transitions.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data.read.column_checks import ActionBounds, check_bounds
from torchrl_osr.lab.data.read.transitions import transitions_of
from torchrl_osr.lab.data.store.cache import CHUNK_ROWS, cache_root, load_or_write
from torchrl_osr.lab.data.store.statistics import describe_episodes
from torchrl_osr.lab.data.store.validation import ACTION_LIMIT, check_dataset

Columns = Mapping[str, NDArray[Any]]
ReadRows = Callable[[int, int], Columns]
"""Columns of the rows from one number up to another."""

# Raise it whenever what is read from a source, or said of it, changes: sets in the
# cache are then converted anew.
READER_VERSION = 2

# One change in a hundred may be lost to rounding before it is said.
VANISHED_SHARE = 0.01

# A trajectory is in memory as a whole; without an end in so many rows, the flags are
# more likely to be missing.
MAX_TRAJECTORY = 2_000_000


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Put what is read before a ValueError that does not name it."""
    try:
        yield
    except ValueError as error:
        if source in str(error):
            raise
        raise ValueError(f"{source}: {error}") from error


@dataclass
class Recording:
    """A recorded set, to be read once.

    Args:
        parts: yields columns of whole trajectories, about so many rows at a time.
        action_bounds: see :func:`~torchrl_osr.lab.data.transitions_from_rows`.
        clip_actions: see there.
        about: JSON-compatible: what the manifest says of the source.
        files: what is read.
        total: rows of the source, for the progress bar.
        num_actions: see :func:`~torchrl_osr.lab.data.load_file`.
    """

    parts: Callable[[int], Iterator[Mapping[str, ArrayLike]]]
    action_bounds: ActionBounds
    clip_actions: bool
    about: dict[str, Any] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    total: int | None = None
    num_actions: int | None = None
    _counts: Counter[str] = field(default_factory=Counter, init=False)
    _outside: int = field(default=0, init=False)
    _changes: dict[str, NDArray[np.int64]] = field(default_factory=dict, init=False)
    _episodes: list[NDArray[Any]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        check_bounds(self.action_bounds)

    def load(
        self, *, on_disk: bool = False, progress: bool = True
    ) -> tuple[TensorDict, dict[str, Any]]:
        """Transitions ``[N]``, and their manifest.

        Keyword Args:
            on_disk: write them into the cache folder, unless they are there, and leave
                them memory-mapped. Default: ``False``, all are read into memory.
            progress: show a bar while writing. Default: ``True``.

        Raises:
            ValueError: see :func:`~torchrl_osr.lab.data.transitions_from_rows`. Row
            numbers
                count from the beginning of the part that the message names.
        """
        with naming(self.about.get("source", "")):
            if on_disk:
                data, manifest = self._load_or_write(progress)
            else:
                (data,) = self._transitions(sys.maxsize)
                check_dataset(data)
                manifest = {"num_transitions": len(data)} | self._manifest()
        for warning in manifest["warnings"]:
            torchrl_logger.warning(warning)
        return data, manifest

    def _load_or_write(self, progress: bool) -> tuple[TensorDict, dict[str, Any]]:
        # Sizes and times, not checksums: to read a large source at each start is slow.
        files = [
            [str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns]
            for file in self.files
        ]
        bounds = [np.asarray(bound).tolist() for bound in self.action_bounds]
        request = self.about | {
            "reader_version": READER_VERSION,
            "source_files": files,
            "action_bounds": bounds,
            "clip_actions": self.clip_actions,
            "num_actions": self.num_actions,
        }
        digest = sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:16]
        return load_or_write(
            cache_root() / "recorded" / f"{self.about['reader']}-{digest}",
            request,
            lambda: self._transitions(CHUNK_ROWS),
            describe=self._manifest,
            total=self.total,
            progress=progress,
        )

    def _transitions(self, rows: int) -> Iterator[TensorDict]:
        """Yield transitions of about so many rows of the source, and count."""
        done, kept, last = 0, 0, None
        seen: set[int] = set()
        for columns in self.parts(rows):
            try:
                part = transitions_of(
                    columns, self.action_bounds, self.clip_actions, self.num_actions
                )
                if "episode" in columns:
                    last = _check_order(columns["episode"], seen, last)
            except ValueError as error:
                where = f"in the rows from {done:,} on: " if done else ""
                raise ValueError(f"{where}{error}") from error
            done += len(part.data) + part.counts["dropped_rows"]
            kept += len(part.data)
            self._counts.update(part.counts)
            self._outside += part.outside
            for name, changes in part.changes.items():
                self._changes[name] = self._changes.get(name, 0) + changes
            self._episodes.append(np.c_[part.returns, part.lengths, part.complete])
            if len(part.data):
                yield part.data
        if not done:
            raise ValueError("the data hold no rows; expected at least one transition.")
        if not kept:
            raise ValueError(
                f"none of the {done} rows has a true next state: each is the last of "
                "its episode. Give next_observation."
            )

    def _manifest(self) -> dict[str, Any]:
        """What is known of the transitions once all have been read."""
        single = len(self.files) == 1
        episodes = np.concatenate(self._episodes)
        complete = episodes[:, 2] == 1
        returns, lengths = episodes[complete, 0], episodes[complete, 1].astype(int)
        bounds = [np.asarray(bound, np.float64) for bound in self.action_bounds]
        return {
            **self.about,
            **({"data_sha256": sha256_of(self.files[0])} if single else {}),
            **self._counts,
            "num_actions": self.num_actions,
            "action_limit": ACTION_LIMIT,
            "action_bounds": [bound.tolist() for bound in bounds],
            **describe_episodes(returns, lengths),
            "incomplete_returns": episodes[~complete, 0].tolist(),
            "incomplete_lengths": episodes[~complete, 1].astype(int).tolist(),
            "warnings": [*self._warnings()],
        }

    def _warnings(self) -> Iterator[str]:
        """Say what the casts and the clipping have changed."""
        for name, (moved, lost) in self._changes.items():
            for entry in np.flatnonzero(lost > VANISHED_SHARE * moved):
                which = f"entry {entry} of {name!r}" if len(moved) > 1 else repr(name)
                yield (
                    f"{which} changes {moved[entry]:,} times from one row to the next, "
                    f"and {lost[entry]:,} of these changes vanish in float32: subtract "
                    "a constant (of a clock, its first value), or leave the entry out."
                )
        if self._outside:
            yield (
                f"{self._outside:,} rows had an action outside of its bounds, which "
                "was clipped, as clip_actions says."
            )


def _check_order(column: ArrayLike, seen: set[int], last: int | None) -> int:
    """Raise if an episode comes back or was seen; return the number of the last."""
    episode = np.asarray(column).reshape(-1)
    for row in np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]]).tolist():
        number = int(episode[row])
        # After a flag within an episode, the next part goes on with it.
        if number in seen and (row or number != last):
            raise ValueError(
                f"'episode' {number} comes back in row {row}; expected the rows of an "
                "episode together, in order of time."
            )
        seen.add(number)
    return int(episode[-1])


def whole_trajectories(read: ReadRows, total: int, rows: int) -> Iterator[Columns]:
    """Yield parts of so many of ``total`` rows, or more if one trajectory has more.

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
                yield columns  # the checks of the columns say what is wrong
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
    count = len(next(iter(columns.values())))
    ends = np.zeros(count, np.bool_)
    for name in ("terminated", "truncated"):
        if name in columns:
            ends |= columns[name].reshape(count, -1).astype(np.bool_).any(1)
    if "episode" in columns:
        episode = columns["episode"].reshape(count, -1)
        ends[:-1] |= (episode[1:] != episode[:-1]).any(1)
    return int(ends.nonzero()[0][-1]) + 1 if ends.any() else 0
