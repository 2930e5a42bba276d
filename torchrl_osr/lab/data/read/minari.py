"""Minari data sets, HDF5 or Arrow, read through the ``minari`` library.

TorchRL 0.11 to 0.14.1 has a reader of them whose every field is zero
(``MinariExperienceReplay``), hence this one. Minari stores ``T + 1`` observations of an
episode, so that every row has its true next observation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict
from tqdm.auto import tqdm

from torchrl_osr._extras import needed_by
from torchrl_osr._files import read_json
from torchrl_osr.lab.data.read.arrays import episode_parts
from torchrl_osr.lab.data.read.column_checks import ActionBounds
from torchrl_osr.lab.data.read.recording import Columns, Recording

with needed_by("Minari data sets need", "minari"):
    import minari
    from minari.storage import get_dataset_path, hosting

    from torchrl_osr.lab.data.read.hdf5 import check_hdf5

# What a damaged set makes Minari's storages raise.
DAMAGE = (
    *(AssertionError, AttributeError, IndexError, KeyError),
    *(OSError, RuntimeError, TypeError, ValueError),
)

Leaves = dict[tuple[str, ...], gymnasium.spaces.Box]


def load_minari(
    dataset: str | Path,
    *,
    download: bool = False,
    observation_keys: Sequence[str] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    on_disk: bool = False,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a Minari data set.

    Observations that are dictionaries become one vector: keys in alphabetical order on
    every level, nested ones in the place of their parent, each array row by row. That
    is the order of :func:`gymnasium.spaces.flatten`.

    Args:
        dataset: id, such as ``"mujoco/hopper/medium-v0"``, below
            ``MINARI_DATASETS_PATH`` or ``~/.minari/datasets``; or the folder of a set.
            A folder of that name goes first.

    Keyword Args:
        download: let Minari fetch a set that is not on this machine. Default:
            ``False``, nothing is fetched.
        observation_keys: of a dictionary, the entries to take and their order; nested
            ones as ``"outer/inner"``. Default: all, in the order above.
        action_bounds: lowest and highest action, mapped to -1 and 1. Default: those of
            the set's action space.
        clip_actions: see :func:`~torchrl_osr.lab.data.transitions_from_rows`.
        on_disk: see :func:`~torchrl_osr.lab.data.load_dataset`. Default: ``False``.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        The transitions ``[N]``, and the manifest of
        :func:`~torchrl_osr.lab.data.transitions_from_rows` with ``reader``, ``source``,
        ``dataset_id``, ``env_id`` (or ``None``), ``minari_version`` and
        ``observation_layout``, a list of names and sizes.

    Raises:
        FileNotFoundError: the set is not on this machine and ``download`` is false.
        ValueError: actions that are not real vectors, observations that are not made
            of them, unknown keys, a damaged set, an HDF5 file that unpacks to more than
            both 4 GiB and its own size or leads into other files, or data that
            :func:`~torchrl_osr.lab.data.transitions_from_rows` refuses.
    """
    opened = open_minari(
        dataset,
        download=download,
        observation_keys=observation_keys,
        action_bounds=action_bounds,
        clip_actions=clip_actions,
        progress=progress and not on_disk,
    )
    return opened.load(on_disk=on_disk, progress=progress)


def open_minari(
    dataset: str | Path,
    *,
    download: bool = False,
    observation_keys: Sequence[str] | None = None,
    action_bounds: ActionBounds | None = None,
    clip_actions: bool = False,
    progress: bool = True,
) -> Recording:
    """Open a Minari data set, see :func:`load_minari`; no episode is read yet."""
    opened = _open(str(dataset), download)
    actions = opened.action_space
    if not isinstance(actions, gymnasium.spaces.Box):
        raise ValueError(
            f"{dataset} has actions {actions}; expected a Box, real vectors. Discrete "
            "actions are not supported by this reader."
        )
    leaves = _chosen(_leaves(opened.observation_space), observation_keys)
    bounds = action_bounds or (actions.low.ravel(), actions.high.ravel())

    spec = opened.env_spec
    about = {
        "reader": "minari",
        "source": str(dataset),
        "dataset_id": opened.id,
        "env_id": None if spec is None else spec.id,
        "minari_version": opened.minari_version,
        "observation_layout": [
            ["/".join(name), int(np.prod(box.shape))] for name, box in leaves.items()
        ],
    }
    files = sorted(Path(opened.storage.data_path).rglob("*"))

    def parts(rows: int) -> Iterator[Columns]:
        return episode_parts(_read_episodes(dataset, opened, leaves, progress), rows)

    return Recording(
        parts,
        bounds,
        clip_actions,
        about,
        [file for file in files if file.is_file()],
        int(opened.total_steps),
    )


def _open(dataset: str, download: bool) -> minari.MinariDataset:
    path = Path(dataset).expanduser()
    here = get_dataset_path(dataset) / "data"
    for folder in (path / "data", path):
        if (folder / "metadata.json").is_file():
            here = folder
            break
    else:
        if download and not here.exists():
            _download(dataset)
    try:
        _check_folder(here)
        return minari.MinariDataset(here)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"Minari set {dataset!r} is not on this machine: fetch it with "
            "download=True (data.download=true), or give its folder."
        ) from error
    except DAMAGE as error:
        raise _damaged(dataset, error) from error


def _download(dataset: str) -> None:
    try:
        hosting.download_dataset(dataset)
    except Exception as error:  # of whatever serves the set
        raise OSError(
            f"Minari set {dataset!r} cannot be downloaded ({type(error).__name__}: "
            f"{error}): check its name and the network."
        ) from error


def _check_folder(folder: Path) -> None:
    """Raise where Minari would read or run what somebody else has put there.

    Without the two spaces it makes the environment of the metadata to ask for them,
    and that can name any function of any package.
    """
    metadata = read_json(folder / "metadata.json")
    for key in ("observation_space", "action_space"):
        if not isinstance(metadata.get(key), str):
            raise ValueError(f"its metadata.json has no {key}")
    if (folder / "main_data.hdf5").exists():
        check_hdf5(folder / "main_data.hdf5")


def _damaged(dataset: str | Path, error: Exception) -> ValueError:
    return ValueError(
        f"Minari cannot read {dataset} ({type(error).__name__}: {error}). Put a "
        "whole copy in its place; if it was downloaded, remove its folder and download "
        "it again (data.download=true)."
    )


def _leaves(space: gymnasium.Space[Any], name: tuple[str, ...] = ()) -> Leaves:
    """Boxes that an observation is made of, in order of their names."""
    if isinstance(space, gymnasium.spaces.Dict):
        parts = [_leaves(space[key], (*name, key)) for key in sorted(space.keys())]
        return {key: box for part in parts for key, box in part.items()}
    if not isinstance(space, gymnasium.spaces.Box):
        raise ValueError(
            f"observation {'/'.join(name) or 'space'} is {space}; expected a Box, or a "
            "Dict of them."
        )
    if space.dtype == np.uint8 and len(space.shape) > 1:
        raise ValueError(
            f"observation {'/'.join(name) or 'space'} is an image, {space.shape}; "
            "expected real vectors."
        )
    return {name: space}


def _chosen(leaves: Leaves, keys: Sequence[str] | None) -> Leaves:
    if keys is None:
        return leaves
    named = {"/".join(name): name for name in leaves}
    if not keys or isinstance(keys, str) or not set(keys) <= set(named):
        raise ValueError(
            f"observation_keys={keys!r}; expected some of {', '.join(named) or 'none'}."
        )
    return {named[key]: leaves[named[key]] for key in keys}


def _read_episodes(
    dataset: str | Path, opened: minari.MinariDataset, leaves: Leaves, progress: bool
) -> Iterator[dict[str, NDArray[Any]]]:
    """Read episode by episode; raise if some of what the set announces is missing."""
    steps = episodes = 0
    try:
        # disable=None: no bar where the output is not a terminal.
        bar = tqdm(
            opened.iterate_episodes(),
            "read",
            opened.total_episodes,
            unit="episode",
            disable=None if progress else True,
        )
        for number, episode in enumerate(bar):
            steps, episodes = steps + len(episode), episodes + 1
            yield {
                "observation": _flatten(number, episode.observations, leaves),
                "action": np.asarray(episode.actions).reshape(len(episode), -1),
                "reward": np.asarray(episode.rewards),
                "terminated": np.asarray(episode.terminations),
                "truncated": np.asarray(episode.truncations),
            }
        announced = opened.total_episodes, opened.total_steps
        if (episodes, steps) != announced:
            raise ValueError(
                f"it gave {episodes} episodes with {steps} steps; "
                f"its metadata say {announced[0]} with {announced[1]}; from Arrow and "
                "Parquet, Minari 0.5.4 reads no more than 32,767 steps of an episode"
            )
    except DAMAGE as error:
        raise _damaged(dataset, error) from error


def _flatten(number: int, observations: Any, leaves: Leaves) -> NDArray[Any]:
    parts = []
    for name, box in leaves.items():
        array = np.asarray(reduce(lambda node, key: node[key], name, observations))
        if array.shape[1:] != box.shape:
            raise ValueError(
                f"observations {'/'.join(name)} of episode {number} have shape "
                f"{array.shape}; expected rows of {box.shape}"
            )
        parts.append(array.reshape(len(array), -1))
    return np.concatenate(parts, axis=1)
