"""D4RL's HDF5 files, read as they are, without the ``d4rl`` package.

TorchRL's ``D4RLExperienceReplay`` zeroes the next observation of every row that is
done, also at time limits; ``d4rl.qlearning_dataset`` puts the next episode's first
observation there. Neither is a state that any action led to.
"""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock
from tensordict import TensorDict
from torch.hub import download_url_to_file
from torchrl import torchrl_logger
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_osr.lab.data.read.column_checks import ActionBounds
from torchrl_osr.lab.data.read.hdf5 import open_hdf5
from torchrl_osr.lab.data.read.recording import (
    Columns,
    ReadRows,
    Recording,
    whole_trajectories,
)
from torchrl_osr.lab.data.store.cache import cache_root

# D4RL's names of our columns; a file's other arrays and groups are not read.
COLUMNS = {
    "observations": "observation",
    "actions": "action",
    "rewards": "reward",
    "terminals": "terminated",
    "timeouts": "truncated",
    "next_observations": "next_observation",
}
REQUIRED = ("observations", "actions", "rewards", "terminals", "timeouts")


def load_d4rl(
    source: str | Path,
    *,
    download: bool = False,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    on_disk: bool = False,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Load a D4RL data set from a file, or by its name.

    Files with ``next_observations`` (v2) keep every row with its true next state. Files
    without (v0, v1) lose the last row of an episode that was cut by a time limit; see
    :func:`~torchrl_osr.lab.data.transitions_from_rows`.

    Args:
        source: path of an HDF5 file (``.hdf5`` or ``.h5``), or a name such as
            ``"hopper-medium-v2"``, which is looked for in the cache folder.

    Keyword Args:
        download: fetch a named set that is not in the cache from D4RL's address. It
            publishes no checksums: compare ``data_sha256`` of the manifest between
            machines. Default: ``False``, nothing is fetched.
        action_bounds: see :func:`~torchrl_osr.lab.data.transitions_from_rows`.
        clip_actions: see there.
        on_disk: see :func:`~torchrl_osr.lab.data.load_dataset`. Default: ``False``.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        The transitions ``[N]`` and the manifest of that function, with ``reader``,
        ``source`` and ``data_sha256``.

    Raises:
        FileNotFoundError: no such file, or a named set that is not in the cache while
            ``download`` is false.
        ValueError: unknown name, no D4RL file, one without ``timeouts``, or data that
            :func:`~torchrl_osr.lab.data.transitions_from_rows` refuses.
    """
    opened = open_d4rl(
        source,
        download=download,
        action_bounds=action_bounds,
        clip_actions=clip_actions,
        progress=progress,
    )
    return opened.load(on_disk=on_disk, progress=progress)


def open_d4rl(
    source: str | Path,
    *,
    download: bool = False,
    action_bounds: ActionBounds = (-1.0, 1.0),
    clip_actions: bool = False,
    progress: bool = True,
) -> Recording:
    """Open a D4RL data set, see :func:`load_d4rl`; of its rows none is read yet."""
    path = _located(source, download, progress)
    total, read_arrays = _open(path)

    def read(start: int, stop: int) -> Columns:
        arrays = read_arrays(start, stop)
        return {COLUMNS[name]: array for name, array in arrays.items()}

    about = {"reader": "d4rl", "source": str(path)}
    parts = partial(whole_trajectories, read, total)
    return Recording(parts, action_bounds, clip_actions, about, [path], total)


def _open(path: Path) -> tuple[int, ReadRows]:
    """Number of rows and what reads them; raise unless all arrays are there."""
    table = open_hdf5(path)
    total, read_arrays = table.select([name for name in table.names if name in COLUMNS])
    arrays = read_arrays(0, 0)
    if missing := [name for name in REQUIRED if name not in arrays]:
        raise ValueError(f"{path} is no D4RL file: it lacks {', '.join(missing)}.")
    return total, read_arrays


def _located(source: str | Path, download: bool, progress: bool) -> Path:
    """Path of a D4RL file, which is fetched if that was asked for."""
    given = Path(source).expanduser()
    if given.suffix in (".hdf5", ".h5"):
        return given.absolute()
    if str(source) not in D4RL_DATASETS:
        raise ValueError(
            f"{str(source)!r} is neither a path that ends in .hdf5 or .h5 nor a D4RL "
            "set, such as hopper-medium-v2; torchrl.data.datasets.d4rl_infos has all."
        )
    path = cache_root() / "d4rl" / f"{source}.hdf5"
    if not path.exists():
        if not download:
            raise FileNotFoundError(
                f"{source} is not at {path}: fetch it with download=True "
                "(data.download=true), or give the path of the file."
            )
        _download(D4RL_DATASETS[str(source)], path, progress)
    return path


def _download(url: str, path: Path, progress: bool) -> None:
    """Fetch a file unless it is there; it is renamed to its place once it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        if path.exists():  # another process may have fetched it in the meantime
            return
        torchrl_logger.info(f"Downloading {url} to {path}.")
        part = path.with_name(f".{path.name}.part")
        try:
            download_url_to_file(
                url, str(part), progress=progress and sys.stderr.isatty()
            )
            _open(part)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
