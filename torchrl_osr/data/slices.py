"""Recorded data that are read slice by slice, for sets that do not fit in memory.

A slice is cut where a trajectory ends, and the next one begins there: no trajectory is
ever in two slices. What is made of a row depends on its trajectory alone, hence the
rows are those of the reader that reads all at once. And since a slice is known by where
it begins, a conversion that was killed goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict

from torchrl_osr.data.collection import ACTION_LIMIT
from torchrl_osr.data.columns import ActionBounds
from torchrl_osr.data.disk_writer import Notes
from torchrl_osr.data.manifest import summarize_episodes
from torchrl_osr.data.trajectories import none_left, transitions_of

Rows = Mapping[str, ArrayLike]

# Some ten megabytes of hopper.
SLICE_ROWS = 200_000

# A trajectory is in memory as a whole; without an end in so many rows, the flags are
# more likely to be missing.
MAX_TRAJECTORY = 2_000_000


class Slices(NamedTuple):
    """A recorded set, to be read in slices of whole trajectories.

    Attributes:
        about: what the manifest says of the source; ``"files"`` are what it reads.
        total: rows of the source.
        read: yields the slices from a position on, 0 at first, each with the position
            after it.
        action_bounds, clip_actions: see
            :func:`~torchrl_osr.data.transitions_from_rows`.
    """

    about: dict[str, Any]
    total: int
    read: Callable[[int], Iterator[tuple[Rows, int]]]
    action_bounds: ActionBounds = (-1.0, 1.0)
    clip_actions: bool = False

    def chunks(self, done: list[Notes]) -> Iterator[tuple[TensorDict, Notes]]:
        """Yield transitions, as :func:`~torchrl_osr.data.write_on_disk` takes them.

        Args:
            done: notes of the slices that are written already.

        Raises:
            ValueError: what :func:`~torchrl_osr.data.transitions_from_rows` raises; row
                numbers count from the beginning of the slice that is named.
        """
        position = done[-1]["position"] if done else 0
        seen = {number for notes in done for number in notes["episodes"]}
        for rows, following in self.read(position):
            try:
                part = transitions_of(
                    rows,
                    action_bounds=self.action_bounds,
                    clip_actions=self.clip_actions,
                )
                episodes = np.unique(np.asarray(rows.get("episode", []))).tolist()
                if again := seen.intersection(episodes):
                    raise ValueError(
                        f"'episode' {min(again)} comes back; expected the rows of an "
                        "episode together, in order of time."
                    )
            except ValueError as error:
                raise ValueError(
                    f"slice {position:,} to {following:,}: {error}"
                ) from error
            seen.update(episodes)
            yield (
                part.data,
                {
                    "position": following,
                    "rows": len(part.data) + part.counts["dropped_rows"],
                    "episodes": episodes,
                    **part.counts,
                    "returns": part.returns,
                    "lengths": part.lengths,
                },
            )
            position = following

    def describe(self, notes: list[Notes]) -> dict[str, Any]:
        """Return the manifest of all slices; the single episodes are not in it.

        Raises:
            ValueError: there were more or fewer rows than announced, or none is left.
        """
        names = ("rows", "dropped_rows", "terminal_rows_filled", "clipped_actions")
        counts = {name: sum(each[name] for each in notes) for name in names}
        if (rows := counts.pop("rows")) != self.total:
            raise ValueError(
                f"{self.about['source']} gave {rows:,} rows; it announces "
                f"{self.total:,}: it is damaged."
            )
        if counts["dropped_rows"] == self.total:
            raise ValueError(none_left(self.total))
        returns, lengths = (
            np.concatenate([each[name] for each in notes])
            for name in ("returns", "lengths")
        )
        return {
            **self.about,
            **counts,
            "action_limit": ACTION_LIMIT,
            **summarize_episodes(returns, lengths),
        }


def whole_trajectories(
    read: Callable[[int, int], Mapping[str, NDArray[Any]]],
    total: int,
    position: int,
    size: int = SLICE_ROWS,
) -> Iterator[tuple[Rows, int]]:
    """Yield slices that end where a trajectory ends.

    Args:
        read: returns the columns of rows from one number up to another.
        total: number of rows.
        position: row to begin with: the first of a trajectory.
        size: rows of a slice; of more, if one trajectory has more. Default: 200,000.

    Raises:
        ValueError: a trajectory has no end within ``MAX_TRAJECTORY`` rows.
    """
    while position < total:
        length, end = size, 0
        while not end:
            stop = min(position + length, total)
            columns = read(position, stop)
            end = stop - position if stop == total else _last_end(columns)
            if not end and length > MAX_TRAJECTORY:
                raise ValueError(
                    f"the trajectory that begins in row {position:,} has no end within "
                    f"{length:,} rows; one must fit in memory: mark ends as truncated, "
                    "or take data.storage=memory."
                )
            length *= 2
        yield {name: column[:end] for name, column in columns.items()}, position + end
        position += end


def _last_end(columns: Mapping[str, NDArray[Any]]) -> int:
    """Return how many rows there are up to the last known end of a trajectory."""
    count = len(columns["reward"]) if "reward" in columns else 0
    ends = np.zeros(count, np.bool_)
    for name in ("terminated", "truncated"):
        if name in columns:
            ends |= columns[name].reshape(count, -1).astype(np.bool_).any(1)
    if "episode" in columns:
        episode = columns["episode"].reshape(count, -1)
        ends[:-1] |= (episode[1:] != episode[:-1]).any(1)
    return int(ends.nonzero()[0][-1]) + 1 if ends.any() else 0
