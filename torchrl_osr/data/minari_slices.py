"""Minari sets, read in slices of whole episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_osr.data.columns import ActionBounds
from torchrl_osr.data.episodes import join_episodes
from torchrl_osr.data.minari_reader import about_minari, open_minari, read_episodes
from torchrl_osr.data.slices import SLICE_ROWS, Rows, Slices


def slices_of_minari(
    dataset: str | Path,
    *,
    download: bool = False,
    observation_keys: Sequence[str] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    size: int = SLICE_ROWS,
) -> Slices:
    """Open a Minari set for reading in slices.

    The rows are those of :func:`~torchrl_osr.data.load_minari`. Positions are numbers
    of episodes.

    Args:
        dataset: as there.

    Keyword Args:
        download, observation_keys, action_bounds, clip_actions: as there.
        size: rows of a slice, at least. Default: 200,000.

    Raises:
        FileNotFoundError: as there.
        ValueError: as there.
    """
    opened, leaves, bounds = open_minari(
        dataset, download, observation_keys, action_bounds
    )

    def read(position: int) -> Iterator[tuple[Rows, int]]:
        waiting: list[tuple[int, Mapping[str, Any]]] = []
        steps = 0
        episodes = read_episodes(dataset, opened, leaves, position)
        for number, episode in enumerate(episodes, position):
            waiting.append((number, episode))
            steps += len(episode["reward"])
            if steps >= size:
                rows, _ = join_episodes(waiting)
                yield rows, number + 1
                waiting, steps = [], 0
        rows, _ = join_episodes(waiting)
        if rows:
            yield rows, opened.total_episodes

    about = about_minari(dataset, opened, leaves, bounds)
    files = sorted(Path(opened.storage.data_path).rglob("*"))
    about["files"] = [str(file) for file in files if file.is_file()]
    return Slices(about, int(opened.total_steps), read, bounds, clip_actions)
