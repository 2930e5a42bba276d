"""Recorded steps that are in memory: as columns, or episode by episode.

Shapes: ``N`` rows, ``T`` steps of an episode, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict

from torchrl_osr.lab.data.read.column_checks import ActionBounds, as_array
from torchrl_osr.lab.data.read.recording import Columns, Recording


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
        The transitions in float32, see :func:`~torchrl_osr.lab.data.check_dataset`,
        and a
        manifest: ``num_transitions``, ``dropped_rows``, ``terminal_rows_filled``,
        ``clipped_actions`` (rows), ``action_limit``, ``action_bounds``, ``num_actions``
        (of discrete ones), the number of ``terminated_ends``, ``truncated_ends`` and
        ``unmarked_ends``, of the complete episodes ``num_complete_episodes``,
        ``return``, ``episode_length``, ``episode_returns`` and ``episode_lengths``, of
        the others ``incomplete_returns`` and ``incomplete_lengths``, and ``warnings``,
        which are logged, too: what the casts have changed.

    Raises:
        ValueError: the columns are not as above, hold a NaN or an infinity, are masked,
            or a field is zero everywhere; the actions look like numbers of discrete
            ones. The message names the column and the row.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.lab.data import transitions_from_rows
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
    return Recording(lambda _: iter([rows]), action_bounds, clip_actions).load()


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
            without a step are skipped.

    Keyword Args:
        action_bounds: see :func:`~torchrl_osr.lab.data.transitions_from_rows`.
        clip_actions: see there.

    Returns:
        What that function returns.

    Raises:
        ValueError: as there; about lengths and sizes the message names the episode.
    """
    parts = partial(episode_parts, episodes)
    return Recording(parts, action_bounds, clip_actions).load()


def episode_parts(
    episodes: Iterable[Mapping[str, ArrayLike]], rows: int
) -> Iterator[Columns]:
    """Yield columns of some episodes, about so many rows at a time."""
    waiting: dict[str, list[NDArray[Any]]] = {}
    sizes: dict[str, tuple[int, ...]] = {}
    steps = number = 0
    for number, episode in enumerate(episodes, 1):
        columns = _columns_of(number - 1, episode)
        if not len(columns["reward"]):
            continue
        for name, array in columns.items():
            if sizes.setdefault(name, array.shape[1:]) != array.shape[1:]:
                raise ValueError(
                    f"episode {number - 1}: a row of {name!r} has shape "
                    f"{list(array.shape[1:])}; it was {list(sizes[name])} before."
                )
            waiting.setdefault(name, []).append(array)
        steps += len(columns["reward"])
        if steps >= rows:
            yield {name: np.concatenate(each) for name, each in waiting.items()}
            waiting, steps = {}, 0
    if steps:
        yield {name: np.concatenate(each) for name, each in waiting.items()}
    if not sizes:
        raise ValueError(f"none of the {number} episodes has a step.")


def _columns_of(number: int, episode: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Columns ``[T, ...]`` of an episode, with its number in each row."""
    names = ("observation", "action", "reward", "terminated", "truncated")
    if missing := [name for name in names if name not in episode]:
        raise ValueError(f"episode {number} lacks {', '.join(missing)}.")
    try:
        columns = {name: as_array(name, values) for name, values in episode.items()}
    except ValueError as error:
        raise ValueError(f"episode {number}: {error}") from error
    shapes = {name: list(array.shape) for name, array in columns.items()}
    steps = columns["reward"].shape[0] if columns["reward"].ndim else -1
    if "next_observation" not in columns and len(columns["observation"]) == steps + 1:
        columns["next_observation"] = columns["observation"][1:]
        columns["observation"] = columns["observation"][:-1]
    wrong = any(array.shape[:1] != (steps,) for array in columns.values())
    if wrong or "next_observation" not in columns:
        raise ValueError(
            f"episode {number} has shapes {shapes}; expected T rows each, and T + 1 "
            "observations or next_observation."
        )
    columns["episode"] = np.full(steps, number)
    return columns
