"""Minari data sets, HDF5 or Arrow, read through the ``minari`` library.

TorchRL 0.11 to 0.14.1 has a reader whose every field is zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from tqdm.auto import tqdm

from torchrl_osr._checks import needed_by
from torchrl_osr._files import read_json
from torchrl_osr.lab.data.columns import Reading, convert
from torchrl_osr.lab.data.environment import sorted_space
from torchrl_osr.lab.data.store import Dataset
from torchrl_osr.lab.data.transitions import Array

with needed_by("Minari data sets need", "minari"):
    import minari
    from minari.storage import get_dataset_path, hosting


def read_minari(
    path: Any, options: Reading, *, download: bool, progress: bool
) -> Dataset:
    """Return the transitions of a Minari set, by its id or folder, and their manifest.

    Bounds of ``None`` are the set's own.
    """
    places = Path(path).expanduser() / "data", get_dataset_path(str(path)) / "data"
    if download and not any(place.is_dir() for place in places):
        hosting.download_dataset(str(path))
    here = next((place for place in places if place.is_dir()), None)
    if here is None:
        raise FileNotFoundError(
            f"Minari set {str(path)!r} is not on this machine: fetch it with "
            f"'torchrl-osr data data=minari data.path={path} data.download=true', or "
            "give its folder."
        )
    # Without its spaces Minari makes the environment of the metadata to ask for them,
    # which can be any function of any package.
    metadata = read_json(here / "metadata.json")
    if not {"observation_space", "action_space"} <= metadata.keys():
        raise ValueError(f"{here / 'metadata.json'} lacks the set's two spaces.")
    opened = minari.MinariDataset(here)
    actions: Any = opened.action_space
    if isinstance(actions, spaces.Discrete):
        options = replace(options, num_actions=int(actions.n), action_bounds=(-1, 1))
    elif not isinstance(actions, spaces.Box):
        raise ValueError(f"{path} has actions {actions}; expected a Box or Discrete.")
    elif options.action_bounds is None:
        bounds = actions.low.ravel(), actions.high.ravel()
        options = replace(options, action_bounds=bounds)
    episodes = [*_read(opened, sorted_space(opened.observation_space), progress)]
    columns = {n: np.concatenate([e[n] for e in episodes]) for n in episodes[0]}
    del episodes  # as large as the columns
    files = sorted(path for path in here.rglob("*") if path.is_file())
    about = {"source": "minari", "path": str(path)}
    return convert([("", columns)], options, about, files)


def _read(
    opened: minari.MinariDataset, space: spaces.Space[Any], progress: bool
) -> Iterator[dict[str, Array]]:
    """Yield each episode's columns; raise if announced parts are missing."""
    steps, first = 0, getattr(opened.action_space, "start", 0)
    total, hidden = opened.total_episodes, None if progress else True
    episodes = opened.iterate_episodes()
    episodes = tqdm(episodes, "read", total, unit="episode", disable=hidden)
    for number, episode in enumerate(episodes):
        count = len(episode.rewards)
        if not count:
            continue
        steps += count
        observation = _flattened(space, episode.observations)
        yield {
            "observation": observation[:-1],
            "next_observation": observation[1:],
            "action": np.asarray(episode.actions).reshape(count, -1) - first,
            "reward": np.asarray(episode.rewards),
            "terminated": np.asarray(episode.terminations),
            "truncated": np.asarray(episode.truncations),
            "episode": np.full(count, number),
        }
    if steps != opened.total_steps:
        raise ValueError(
            f"{opened.id} holds {steps} steps where its metadata say "
            f"{opened.total_steps}: the set is damaged, or has an episode of more than "
            "32,767 steps in Arrow or Parquet, which Minari 0.5.4 reads in part."
        )


def _flattened(space: Any, observations: Any) -> Any:
    """Return rows ``[T + 1, S]`` of observations, in the order of their space."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        keys: Any = space if isinstance(space, spaces.Dict) else range(len(space))
        parts = [_flattened(space[key], observations[key]) for key in keys]
        return np.concatenate(parts, axis=1)
    array = np.asarray(observations)
    if isinstance(space, spaces.Box):
        return array.reshape(len(array), -1)
    rows: list[Any] = [spaces.flatten(space, each) for each in array]
    return np.stack(rows)
