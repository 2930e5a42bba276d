"""Data sets in the cache folder: made at first use, opened ever after.

One folder a data set, as :func:`~torchrl_osr.lab.data.write_memmap` writes it. Its
manifest
says what the data were made from; a set that does not fit or is damaged is made anew.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import FileLock
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr._extras import needed_by
from torchrl_osr.lab.data.store.memmap import (
    explained_write_errors,
    load_memmap,
    write_memmap,
)

CACHE_VARIABLE = "TORCHRL_OSR_CACHE"
"""Environment variable that moves the cache folder."""

CHUNK_ROWS = 200_000
"""Rows that are converted and written at a time: some ten megabytes of hopper."""


def cache_root(cache_dir: Path | str | None = None) -> Path:
    """Folder of all cached data sets: as given, or as the user has it."""
    root = cache_dir or os.environ.get(CACHE_VARIABLE)
    if root is None:
        with needed_by("the cache needs", "train"):
            import platformdirs
        root = platformdirs.user_cache_dir("torchrl-osr")
    return Path(root).expanduser()


def load_or_write(
    folder: Path,
    request: Mapping[str, Any],
    chunks: Callable[[], Iterable[TensorDict]],
    *,
    describe: Callable[[], Mapping[str, Any]] = dict,
    total: int | None = None,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Open a cached set, or write it first, with what :func:`write_memmap` takes.

    Processes that ask for the same set at once wait for one of them to write it.

    Args:
        folder: of the set.
        request: JSON-compatible entries of the manifest that decide the rows. A set
            with others is written anew, with a warning that says why.
        chunks: makes the transitions.

    Returns:
        The memory-mapped transitions ``[N]`` and the manifest.
    """
    wanted = json.loads(json.dumps(request))  # as the manifest's: it has no tuples
    # Without the lock first: a whole set can be read from a folder that is read-only.
    with suppress(OSError, ValueError):
        return _load(folder, wanted)
    with explained_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(f"{folder}.lock")
        lock.acquire()
    try:
        # Another process may have written it while this one waited for the lock.
        return _load(folder, wanted)
    except (OSError, ValueError) as flaw:
        if folder.exists():
            torchrl_logger.warning(f"Making {folder} anew: {flaw}")
        return write_memmap(
            chunks(),
            folder,
            describe=lambda: wanted | dict(describe()),
            total=total,
            progress=progress,
        )
    finally:
        lock.release()


def _load(folder: Path, request: dict[str, Any]) -> tuple[TensorDict, dict[str, Any]]:
    """Open a set; raise OSError or ValueError, with the reason, if it does not fit."""
    data, manifest = load_memmap(folder)
    for key, wanted in request.items():
        if manifest.get(key) != wanted:
            raise ValueError(f"its {key} is {manifest.get(key)!r}, wanted {wanted!r}.")
    return data, manifest
