"""From recorded steps to the transitions that training reads.

What every reader has in common: which row ends a trajectory, which row has a true next
state, what is dropped for want of one, and how well the recorded behaviour did.

Shapes: ``N`` rows, ``T`` steps of an episode, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict

from torchrl_osr.data.read.column_checks import ActionBounds, checked_columns
from torchrl_osr.data.store.statistics import describe_episodes
from torchrl_osr.data.store.validation import (
    ACTION_LIMIT,
    as_transitions,
    check_dataset,
)

Columns = dict[str, NDArray[Any]]

# Two recordings of one state may differ by rounding, relative to its entries.
SAME_STATE = 1e-6


def transitions_from_rows(
    rows: Mapping[str, ArrayLike],
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
) -> tuple[TensorDict, dict[str, Any]]:
    """Turn recorded steps, in order of time, into a data set.

    A trajectory ends where a row is terminated or truncated, where the episode number
    changes, and at the last row; an end without a flag becomes ``truncated``. Without
    ``next_observation``, a row's next state is the observation of the following row.
    The last row of a trajectory has none: if it is terminated it stays, with its own
    observation in that place, which no loss reads; else it is dropped and counted, and
    the row before it becomes ``truncated``.

    Args:
        rows: ``observation`` ``[N, S]``, ``action`` ``[N, A]``, ``reward`` and
            ``terminated`` ``[N]`` or ``[N, 1]``; of the same shape ``truncated`` or
            ``episode`` (whole numbers) or both; possibly ``next_observation``
            ``[N, S]``. Flags are bool, or 0 and 1.

    Keyword Args:
        action_bounds: lowest and highest action, mapped to -1 and 1. Default: -1 and 1.
            The actions are then clipped to ±0.999, see ``ACTION_LIMIT``.
        clip_actions: clip actions that are outside of their bounds, as MuJoCo does with
            what it is given, rather than raise. Default: ``False``.

    Returns:
        The transitions in float32, see :func:`~torchrl_osr.data.check_dataset`, and a
        manifest: ``num_transitions``, ``dropped_rows``, ``terminal_rows_filled``,
        ``clipped_actions`` (rows), ``action_limit``, and of the complete episodes
        ``num_complete_episodes``, ``return``, ``episode_length``, ``episode_returns``
        and ``episode_lengths``.

    Raises:
        ValueError: the columns are not as above, hold a NaN or an infinity, or a field
            is zero everywhere. The message names the column and the row.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.data import transitions_from_rows
        >>> rows = {
        ...     "observation": np.arange(1.0, 9.0).reshape(4, 2),
        ...     "action": np.full((4, 1), 0.5),
        ...     "reward": np.ones(4),
        ...     "terminated": [False, True, False, False],
        ...     "truncated": [False, False, False, True],
        ... }
        >>> data, manifest = transitions_from_rows(rows)
        >>> data["next", "observation"].tolist()  # of row 1: no loss reads it
        [[3.0, 4.0], [3.0, 4.0], [7.0, 8.0]]
        >>> manifest["dropped_rows"], manifest["episode_returns"]
        (1, [2.0, 2.0])
    """
    part = transitions_of(rows, action_bounds=action_bounds, clip_actions=clip_actions)
    if not len(part.data):
        raise ValueError(none_left(part.counts["dropped_rows"]))
    check_dataset(part.data)
    return part.data, {
        "num_transitions": len(part.data),
        **part.counts,
        "action_limit": ACTION_LIMIT,
        **describe_episodes(part.returns, part.lengths),
    }


def transitions_from_episodes(
    episodes: Iterable[Mapping[str, ArrayLike]],
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
) -> tuple[TensorDict, dict[str, Any]]:
    """Turn recorded episodes into a data set; they are read once, one by one.

    Args:
        episodes: each with ``observation`` ``[T + 1, S]``, the last after the last
            action, or ``[T, S]`` with ``next_observation`` ``[T, S]``; ``action``
            ``[T, A]``; ``reward``, ``terminated`` and ``truncated`` ``[T]``. Episodes
            without a step are skipped and counted.

    Keyword Args:
        action_bounds: see :func:`~torchrl_osr.data.transitions_from_rows`.
        clip_actions: see there.

    Returns:
        What that function returns, and ``empty_episodes`` in the manifest.

    Raises:
        ValueError: as there; about lengths and sizes the message names the episode.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.data import transitions_from_episodes
        >>> episode = {
        ...     "observation": np.ones((4, 2)),
        ...     "action": np.full((3, 1), 0.5),
        ...     "reward": np.ones(3),
        ...     "terminated": np.zeros(3, bool),
        ...     "truncated": np.array([False, False, True]),
        ... }
        >>> data, manifest = transitions_from_episodes([episode, episode])
        >>> len(data), manifest["episode_lengths"]
        (6, [3, 3])
    """
    rows, empty = join_episodes(enumerate(episodes))
    if not rows:
        raise ValueError(f"none of the {empty} episodes has a step.")
    data, manifest = transitions_from_rows(
        rows, action_bounds=action_bounds, clip_actions=clip_actions
    )
    return data, manifest | {"empty_episodes": empty}


class Trajectories(NamedTuple):
    """Transitions of some whole trajectories, and what is known of them.

    Attributes:
        data: flat tensordict ``[N]``; of a part of a data set, it may have no rows.
        counts: dropped, filled and clipped rows, as the manifest names them.
        returns, lengths: of the complete episodes.
    """

    data: TensorDict
    counts: dict[str, int]
    returns: list[float]
    lengths: list[int]


def none_left(rows: int) -> str:
    """Message about data that have no next states."""
    return (
        f"none of the {rows} rows has a true next state: each is the last of its "
        "episode. Give next_observation."
    )


def transitions_of(
    rows: Mapping[str, ArrayLike], *, action_bounds: ActionBounds, clip_actions: bool
) -> Trajectories:
    """Turn whole trajectories, of a data set or a part of one, into transitions.

    See :func:`transitions_from_rows`, which also looks for what only a whole set can
    lack.
    """
    columns, clipped = checked_columns(
        rows, action_bounds=action_bounds, clip_actions=clip_actions
    )
    count = len(columns["reward"])
    columns.setdefault("truncated", np.zeros(count, np.bool_))
    flagged = columns["terminated"] | columns["truncated"]
    ends = flagged | _last_rows(columns.pop("episode", None), count)
    returns, lengths = _episode_statistics(
        columns, ends, flagged, np.asarray(rows["reward"]), trusted="episode" in rows
    )
    keep, filled = _fill_next_observations(columns, ends)
    columns["truncated"] = _mark_cuts(columns, ends, keep)
    if not keep.all():
        columns = {name: column[keep] for name, column in columns.items()}
    counts = {
        "dropped_rows": int(count - keep.sum()),
        "terminal_rows_filled": filled,
        "clipped_actions": clipped,
    }
    return Trajectories(
        as_transitions(columns), counts, returns.tolist(), lengths.tolist()
    )


def _last_rows(episode: NDArray[Any] | None, count: int) -> NDArray[np.bool_]:
    """Mask of the rows that are followed by another episode, or by none."""
    last = np.zeros(count, np.bool_)
    last[-1] = True
    if episode is not None:
        last[:-1] = episode[1:] != episode[:-1]
        first = np.flatnonzero(np.r_[True, last[:-1]])
        numbers, seen = np.unique(episode[first], return_counts=True)
        if (seen > 1).any():
            again = numbers[seen > 1][0]
            raise ValueError(
                f"'episode' {again} comes back in row "
                f"{first[episode[first] == again][1]}; expected the rows of an episode "
                "together, in order of time."
            )
    return last


def _episode_statistics(
    columns: Columns,
    ends: NDArray[np.bool_],
    flagged: NDArray[np.bool_],
    reward: NDArray[Any],
    *,
    trusted: bool,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns and lengths of the episodes that were recorded to their end."""
    stops = np.flatnonzero(ends)
    starts = np.r_[0, stops[:-1] + 1]
    complete = flagged[stops]
    if "next_observation" in columns and not trusted:
        # Rows that do not follow one another have no sum of rewards.
        before, after = columns["next_observation"][:-1], columns["observation"][1:]
        slack = SAME_STATE * np.maximum(1, np.abs(after))
        jumps = (np.abs(before - after) > slack).any(1) & ~ends[:-1]
        complete &= np.add.reduceat(np.r_[jumps, False].astype(int), starts) == 0
    reward = reward.reshape(-1).astype(np.float64)
    returns = np.add.reduceat(reward, starts)[complete]
    return returns, (stops - starts + 1)[complete]


def _fill_next_observations(
    columns: Columns, ends: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], int]:
    """Fill in what is missing; return which rows stay, and how many ends are filled."""
    if "next_observation" in columns:
        return np.ones(len(ends), np.bool_), 0
    observation, terminated = columns["observation"], columns["terminated"]
    next_observation = np.roll(observation, -1, axis=0)
    next_observation[terminated] = observation[terminated]
    columns["next_observation"] = next_observation
    return ~ends | terminated, int(terminated.sum())


def _mark_cuts(
    columns: Columns, ends: NDArray[np.bool_], keep: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Mark trajectories that end without a flag, or before a dropped row."""
    last = ends.copy()
    last[:-1] |= ~keep[1:]  # only an end is dropped, so the row before goes on to it
    truncated: NDArray[np.bool_] = columns["truncated"] | (
        last & ~columns["terminated"]
    )
    return truncated


def join_episodes(
    episodes: Iterable[tuple[int, Mapping[str, ArrayLike]]],
) -> tuple[dict[str, NDArray[Any]], int]:
    """Columns of numbered episodes, and the number of those without a step."""
    parts: dict[str, list[NDArray[Any]]] = {}
    sizes: dict[str, tuple[int, ...]] = {}
    empty = 0
    for number, episode in episodes:
        rows = _rows_of(number, episode)
        if not len(rows["reward"]):
            empty += 1
            continue
        for name, array in rows.items():
            if sizes.setdefault(name, array.shape[1:]) != array.shape[1:]:
                raise ValueError(
                    f"episode {number}: a row of {name!r} has shape "
                    f"{list(array.shape[1:])}; it was {list(sizes[name])} before."
                )
            parts.setdefault(name, []).append(array)
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}, empty


def _rows_of(number: int, episode: Mapping[str, ArrayLike]) -> dict[str, NDArray[Any]]:
    names = ("observation", "action", "reward", "terminated", "truncated")
    if missing := [name for name in names if name not in episode]:
        raise ValueError(f"episode {number} lacks {', '.join(missing)}.")
    try:
        rows = {name: np.asarray(values) for name, values in episode.items()}
    except ValueError as error:
        raise ValueError(f"episode {number} has rows of unequal length.") from error
    steps = rows["reward"].shape[0] if rows["reward"].ndim else -1
    if "next_observation" not in rows and len(rows["observation"]) == steps + 1:
        rows["next_observation"] = rows["observation"][1:]
        rows["observation"] = rows["observation"][:-1]
    wrong = {name: a.shape for name, a in rows.items() if a.shape[:1] != (steps,)}
    if wrong or "next_observation" not in rows:
        raise ValueError(
            f"episode {number} has shapes "
            f"{ {name: list(array.shape) for name, array in rows.items()} }; expected "
            "T rows each, and T + 1 observations or next_observation."
        )
    rows["episode"] = np.full(steps, number)
    return rows
