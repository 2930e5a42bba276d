"""The cache of rolled-out transitions, and replay buffers of any data.

A cached set is a folder with ``rows``, files of ``TensorDict.memmap``, and
``manifest.json``, which describes them and holds their checksum.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from platformdirs import user_cache_dir
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_osr._files import read_json, sha256_of, write_json
from torchrl_osr.lab.data.transitions import DATASET_KEYS, check_dataset

Dataset = tuple[TensorDict, dict[str, Any]]
"""Transitions ``[N]`` and their manifest."""

MANIFEST, ROWS = "manifest.json", "rows"

# Raise the number whenever the files or the required entries of the manifest change.
FORMAT = "torchrl-osr transitions 2"


def cache_root() -> Path:
    """Return the folder of cached data: ``TORCHRL_OSR_CACHE``, or the user's."""
    root = os.environ.get("TORCHRL_OSR_CACHE")
    return Path(root or user_cache_dir("torchrl-osr")).expanduser()


def load_or_write(
    folder: Path, request: Mapping[str, Any], make: Callable[[], Dataset]
) -> Dataset:
    """Read a cached data set; make it first if its manifest differs from ``request``.

    ``make`` returns transitions, and entries of the manifest besides ``request``.
    Processes that ask for the same data set at once wait for one of them to write it.
    """
    wanted = json.loads(json.dumps(request))  # like the manifest's: without tuples

    def load() -> Dataset:
        manifest = read_json(folder / MANIFEST)
        for key, value in {**wanted, "format": FORMAT}.items():
            if (was := manifest.get(key)) != value:
                raise ValueError(f"its {key} is {was!r}, wanted {value!r}.")
        if manifest.get("rows_sha256") != _checksum(folder / ROWS):
            raise ValueError("its checksum is wrong: the files are damaged.")
        data = TensorDict.load_memmap(folder / ROWS, allow_pickle=False)
        return data.clone(), manifest

    # Without the lock first: a data set can be read from a read-only folder.
    with suppress(OSError, ValueError):
        return load()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{folder}.lock"):
        try:
            return load()  # another process may have written it in the meantime
        except (OSError, ValueError) as flaw:
            if folder.exists():
                torchrl_logger.warning(f"Making {folder} anew: {flaw}")
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
        if not names <= {MANIFEST, ROWS}:
            raise FileExistsError(f"{folder} is not replaced: it holds other files.")
        data, about = make()
        check_dataset(data)
        partial = folder.with_name(f".{folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)  # of a killed process
        try:
            data.select(*DATASET_KEYS).memmap(partial / ROWS)
            manifest = {**wanted, **about, "format": FORMAT}
            manifest["num_transitions"] = len(data)
            manifest["rows_sha256"] = _checksum(partial / ROWS)
            write_json(partial / MANIFEST, manifest)
            shutil.rmtree(folder, ignore_errors=True)
            os.replace(partial, folder)
        finally:  # an interrupted call leaves nothing
            shutil.rmtree(partial, ignore_errors=True)
        return load()


def _checksum(folder: Path) -> str:
    """Return the SHA-256 of the files of the rows."""
    return checksum_of(sorted(path for path in folder.rglob("*") if path.is_file()))


def checksum_of(files: Iterable[Path]) -> str:
    """Return the SHA-256 of the contents of files, wherever they are."""
    digests = [sha256_of(path) for path in files]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def make_replay_buffer(
    data: TensorDictBase,
    *,
    batch_size: int,
    seed: int,
    device: torch.device | str | None = None,
) -> ReplayBuffer:
    """Return a replay buffer that samples a data set uniformly, with replacement.

    The batches depend on ``seed`` alone: the buffer has a generator of its own, and
    does not prefetch, because threads would make the order of the draws depend on time.
    """
    device = torch.device(device or data.device or "cpu")
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(len(data), device=device),
        batch_size=batch_size,
        generator=torch.Generator(device).manual_seed(seed),
    )
    buffer.extend(data.to(device))
    return buffer
