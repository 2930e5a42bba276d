"""From recorded steps of whole trajectories to the transitions that training reads.

Which row ends a trajectory, which has a true next state, what is dropped for want of
one, and how well the recorded behaviour did: the same for every reader.

Shapes: ``N`` rows, ``E`` trajectories.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict

from torchrl_osr.lab.data.read.column_checks import ActionBounds, checked_columns
from torchrl_osr.lab.data.store.next_action import SAME_STATE
from torchrl_osr.lab.data.store.validation import as_transitions


class Trajectories(NamedTuple):
    """Transitions of some whole trajectories, and what is known of them.

    Attributes:
        data: flat tensordict ``[N]``; of a part of a data set, it may have no rows.
        counts: dropped, filled and clipped rows, and kinds of ends, as the manifest
            names them.
        returns, lengths: of the trajectories, ``[E]``.
        complete: which of these are known to have been recorded to their end, ``[E]``.
        outside: rows whose action was outside of its bounds, and was clipped.
        changes: see :class:`~torchrl_osr.lab.data.read.column_checks.Checked`.
    """

    data: TensorDict
    counts: dict[str, int]
    returns: NDArray[np.float64]
    lengths: NDArray[np.int64]
    complete: NDArray[np.bool_]
    outside: int
    changes: dict[str, NDArray[np.int64]]


def transitions_of(
    rows: Mapping[str, ArrayLike],
    action_bounds: ActionBounds,
    clip_actions: bool,
    num_actions: int | None = None,
) -> Trajectories:
    """Transitions of whole trajectories, of a data set or a part of one.

    The rule is that of :func:`~torchrl_osr.lab.data.transitions_from_rows`.
    """
    columns, clipped, outside, changes = checked_columns(
        rows, action_bounds, clip_actions, num_actions
    )
    episode, terminated = columns.pop("episode", None), columns["terminated"]
    truncated = columns.get("truncated", np.zeros_like(terminated))
    flagged = terminated | truncated
    ends = flagged.copy()
    ends[-1] = True
    if episode is not None:
        ends[:-1] |= episode[1:] != episode[:-1]

    stops = np.flatnonzero(ends)
    starts = np.r_[0, stops[:-1] + 1]
    complete = flagged[stops]
    if "next_observation" in columns and episode is None:
        # Rows that do not follow one another have no sum of rewards.
        broken = np.r_[_jumps(columns) & ~ends[:-1], False]
        complete &= ~np.logical_or.reduceat(broken, starts)
    reward = np.asarray(rows["reward"], np.float64).reshape(-1)
    returns, lengths = np.add.reduceat(reward, starts), stops - starts + 1

    keep, filled = np.ones_like(ends), 0
    if "next_observation" not in columns:
        observation = columns["observation"]
        columns["next_observation"] = np.roll(observation, -1, axis=0)
        columns["next_observation"][terminated] = observation[terminated]
        keep, filled = ~ends | terminated, int(terminated.sum())
    # Only an end is dropped: its trajectory is then cut at the row before.
    last = ends.copy()
    last[:-1] |= ~keep[1:]
    columns["truncated"] = truncated | (last & ~terminated)
    if not keep.all():
        columns = {name: column[keep] for name, column in columns.items()}
    counts = {
        "dropped_rows": int((~keep).sum()),
        "terminal_rows_filled": filled,
        "clipped_actions": clipped,
        "terminated_ends": int(terminated[stops].sum()),
        "truncated_ends": int((truncated & ~terminated)[stops].sum()),
        "unmarked_ends": int((~flagged)[stops].sum()),
    }
    data = as_transitions(columns)
    return Trajectories(data, counts, returns, lengths, complete, outside, changes)


def _jumps(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Rows ``[N - 1]`` whose next observation is not the observation of the next."""
    before, after = columns["next_observation"][:-1], columns["observation"][1:]
    slack = SAME_STATE * np.maximum(1, np.abs(after))
    jumps: NDArray[np.bool_] = (np.abs(before - after) > slack).any(1)
    return jumps
