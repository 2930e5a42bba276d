"""D4RL's HDF5 files, read as they are, without the ``d4rl`` package.

TorchRL's ``D4RLExperienceReplay`` zeroes the next observation of every row that is
done, also at time limits; ``d4rl.qlearning_dataset`` puts the next episode's first
observation there. Neither is a state that any action led to.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from filelock import FileLock
from torch.hub import download_url_to_file
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_osr.lab.data.recording import Recording
from torchrl_osr.lab.data.store import cache_root
from torchrl_osr.lab.data.table import open_log
from torchrl_osr.lab.data.transitions import Reading

# Our names of D4RL's arrays; others are not read, next_observations are in v2 alone.
COLUMNS = {
    "observation": "observations",
    "action": "actions",
    "reward": "rewards",
    "terminated": "terminals",
    "truncated": "timeouts",
}


def open_d4rl(
    source: Any,
    options: Reading,
    *,
    download: bool = False,
    progress: bool = True,
) -> Recording:
    """Open a D4RL data set; no row is read yet.

    Args:
        source: path of an HDF5 file, or a name such as ``"hopper-medium-v2"``, which is
            looked for in the cache folder.
        options: for the conversion.

    Keyword Args:
        download: fetch a named set from D4RL's address, which publishes no checksums.
            Default: ``False``.
        progress: show a progress bar when on a terminal. Default: ``True``.
    """
    path = Path(source).expanduser()
    if path.suffix not in (".hdf5", ".h5"):
        if str(source) not in D4RL_DATASETS:
            raise ValueError(
                f"{str(source)!r} is neither a path that ends in .hdf5 or .h5 nor a "
                "D4RL set, such as hopper-medium-v2."
            )
        path = cache_root() / "d4rl" / f"{source}.hdf5"
        if download:
            _download(D4RL_DATASETS[str(source)], path, progress)
        if not path.exists():
            raise FileNotFoundError(
                f"{source} is not at {path}: fetch it with data.download=true, or give "
                "the path of the file."
            )
    recording = open_log(path, COLUMNS, options)
    recording.about["source"] = "d4rl"
    return recording


def _download(url: str, path: Path, progress: bool) -> None:
    """Fetch a file unless it is there; it is renamed to its place once it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.part.hdf5")
    with FileLock(f"{path}.lock"):
        if path.exists():  # another process may have fetched it in the meantime
            return
        try:
            progress = progress and sys.stderr.isatty()
            download_url_to_file(url, str(part), progress=progress)
            open_log(part, COLUMNS, Reading())
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
