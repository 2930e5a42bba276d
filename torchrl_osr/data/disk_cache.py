"""Data sets in the cache folder, to be read from disk as their rows are drawn.

A set is written once, and again where what it was made of has changed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from torchrl_osr.data import local
from torchrl_osr.data.disk_writer import Notes, write_on_disk
from torchrl_osr.data.mixtures import load_mixture
from torchrl_osr.data.on_disk import MANIFEST, TransitionsOnDisk
from torchrl_osr.data.slices import SLICE_ROWS, Slices

Stored = tuple[TransitionsOnDisk, dict[str, Any]]


def store_recorded(level: str, path: str, download: bool, progress: bool) -> Stored:
    """Open a recorded set on disk; at first use it is written, slice by slice.

    Args:
        level: ``"minari"``, ``"d4rl"`` or ``"file"``.
        path: what the reader takes; with ``"file"`` also a folder that
            :func:`~torchrl_osr.data.write_on_disk` has written.
        download: let the reader fetch a set that it knows by name.
        progress: show a progress bar when on a terminal.

    Returns:
        The set and its manifest.

    Raises:
        FileNotFoundError: there is no such set.
        ValueError: it cannot be read in slices, or its reader refuses it.
    """
    if level == "file" and (Path(path).expanduser() / MANIFEST).is_file():
        stored = TransitionsOnDisk(path)
        return stored, stored.manifest
    slices = _open(level, path, download, progress)
    about = dict(slices.about)
    # Not a checksum: to read a large file at each start takes minutes.
    files = [Path(name) for name in about.pop("files", [about["source"]])]
    request = about | {
        "level": level,
        "files": [
            [str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns] for f in files
        ],
    }
    stored = write_on_disk(
        slices.chunks,
        _folder(level, request),
        request=request,
        describe=slices._replace(about=about).describe,
        total=slices.total,
        progress=progress,
    )
    return stored, stored.manifest


def store_mixture(
    env_name: str, level: str, *, progress: bool = True, **mixture: Any
) -> Stored:
    """Open a rolled-out set on disk; at first use it is collected and written.

    To collect it takes the memory of the whole set, once.

    Args:
        env_name: as in :func:`~torchrl_osr.data.load_mixture`.
        level: as there.

    Keyword Args:
        progress: show a progress bar when on a terminal. Default: ``True``.
        **mixture: ``random_share``, ``num_transitions`` and ``seed``.

    Returns:
        The set and its manifest.
    """
    rows, seed = mixture["num_transitions"], mixture.get("seed", 0)
    levels = [level, "random"] if mixture["random_share"] else [level]
    request = mixture | {
        "sources": [local.request_of(env_name, each, rows, seed) for each in levels]
    }
    manifest: dict[str, Any] = {}

    def chunks(done: list[Notes]) -> Iterator[tuple[TensorDict, Notes]]:
        data, about = load_mixture(env_name, level, progress=progress, **mixture)
        manifest.update(about)
        for start in range(len(done) * SLICE_ROWS, len(data), SLICE_ROWS):
            yield data[start : start + SLICE_ROWS], {}

    stored = write_on_disk(
        chunks,
        _folder(f"{env_name}-{level}", request),
        request=request,
        describe=lambda _: manifest,
        total=rows,
        progress=progress,
    )
    return stored, stored.manifest


def _open(level: str, path: str, download: bool, progress: bool) -> Slices:
    # Each reader needs a library of its own, and only the one that is asked for.
    if level == "minari":
        from torchrl_osr.data.minari_slices import slices_of_minari

        return slices_of_minari(path, download=download)
    if level == "d4rl":
        from torchrl_osr.data.d4rl_reader import slices_of_d4rl

        return slices_of_d4rl(path, download=download, progress=progress)
    from torchrl_osr.data.file_slices import slices_of_file

    return slices_of_file(path)


def _folder(name: str, request: dict[str, Any]) -> Path:
    digest = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()
    return local.cache_root(None) / "on-disk" / f"{name}-{digest[:16]}"
