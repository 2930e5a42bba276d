"""The cache of rolled-out transitions, and replay buffers of any data."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from platformdirs import user_cache_dir
from tensordict import TensorDict, TensorDictBase
from torchrl import torchrl_logger
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_osr._files import read_tensors, write_tensors
from torchrl_osr.lab.data.transitions import DATASET_KEYS, check_dataset

Dataset = tuple[TensorDict, dict[str, Any]]
"""Transitions ``[N]`` and their manifest."""

# Raise the number whenever the files or the required entries of the manifest change.
FORMAT = "torchrl-osr transitions 3"


def cache_root() -> Path:
    """Return the folder of cached data: ``TORCHRL_OSR_CACHE``, or the user's."""
    root = os.environ.get("TORCHRL_OSR_CACHE")
    return Path(root or user_cache_dir("torchrl-osr")).expanduser()


def load_or_write(
    path: Path, request: Mapping[str, Any], make: Callable[[], Dataset]
) -> Dataset:
    """Read a cached data set; make it first if its manifest differs from ``request``.

    The file holds the rows as tensors, and the manifest as their record. ``make``
    returns transitions, and entries of the manifest besides ``request``. Processes that
    ask for the same data set at once wait for one of them to write it.
    """
    wanted = json.loads(json.dumps(request))  # like the manifest's: without tuples

    def load() -> Dataset:
        rows, manifest = read_tensors(path)
        for key, value in {**wanted, "format": FORMAT}.items():
            if (was := manifest.get(key)) != value:
                raise ValueError(f"its {key} is {was!r}, wanted {value!r}.")
        data = TensorDict(rows, [manifest["num_transitions"]])
        return data.unflatten_keys(), manifest

    # Without the lock first: a data set can be read from a read-only folder.
    with suppress(OSError, ValueError):
        return load()
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        try:
            return load()  # another process may have written it in the meantime
        except (OSError, ValueError) as flaw:
            if path.exists():
                torchrl_logger.warning(f"Making {path} anew: {flaw}")
        data, about = make()
        check_dataset(data)
        manifest = {**wanted, **about, "format": FORMAT, "num_transitions": len(data)}
        write_tensors(path, data.select(*DATASET_KEYS).flatten_keys(), manifest)
        return load()


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
    return ReplayBuffer(
        storage=TensorStorage(data.to(device), device=device),
        batch_size=batch_size,
        generator=torch.Generator(device).manual_seed(seed),
    )
