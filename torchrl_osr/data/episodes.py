"""From recorded episodes to the transitions that training reads, in one pass.

Shapes: ``T`` steps of an episode, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict
from tqdm.auto import tqdm

from torchrl_osr.data.columns import ActionBounds
from torchrl_osr.data.trajectories import transitions_from_rows


def transitions_from_episodes(
    episodes: Iterable[Mapping[str, ArrayLike]],
    *,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    total: int | None = None,
    progress: bool = True,
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
        total: number of episodes, for the bar. Default: unknown.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        What that function returns, and ``empty_episodes`` in the
        manifest.

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
    # disable=None: no bar where the output is not a terminal.
    bar = tqdm(
        episodes, "read", total, unit="episode", disable=None if progress else True
    )
    rows, empty = join_episodes(enumerate(bar))
    if not rows:
        raise ValueError(f"none of the {empty} episodes has a step.")
    data, manifest = transitions_from_rows(
        rows, action_bounds=action_bounds, clip_actions=clip_actions
    )
    return data, manifest | {"empty_episodes": empty}


def join_episodes(
    episodes: Iterable[tuple[int, Mapping[str, ArrayLike]]],
) -> tuple[dict[str, NDArray[Any]], int]:
    """Return the columns of numbered episodes, and how many of them have no step."""
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
