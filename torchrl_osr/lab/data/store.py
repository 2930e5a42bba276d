"""Memory-mapped transitions, their cache folder, and replay buffers of any data.

A data set is a folder with ``rows``, files of ``TensorDict.memmap``, and
``manifest.json``, which describes them and holds their checksum.
"""

from __future__ import annotations

import hashlib
import json
import operator
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeGuard

import torch
from filelock import FileLock
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from torch import Tensor
from torchrl import torchrl_logger
from torchrl.data import ImmutableDatasetWriter, LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.storages import Storage
from torchrl.envs.transforms import Transform

from torchrl_osr._extras import needed_by
from torchrl_osr._files import check_disk_space, read_json, sha256_of, write_json
from torchrl_osr.lab.data.transitions import DATASET_KEYS, check_dataset

Dataset = tuple[TensorDict, dict[str, Any]]
"""Transitions ``[N]`` and their manifest."""

CHUNK_ROWS = 200_000
"""Rows that are converted and written at a time: some ten megabytes of hopper."""

MANIFEST, ROWS = "manifest.json", "rows"

# Raise the number whenever the files or the required entries of the manifest change.
FORMAT = "torchrl-osr transitions 2"


def cache_root() -> Path:
    """Return the folder of cached data: ``TORCHRL_OSR_CACHE``, or the user's."""
    root = os.environ.get("TORCHRL_OSR_CACHE")
    if root is None:
        with needed_by("the cache needs", "train"):
            import platformdirs
        root = platformdirs.user_cache_dir("torchrl-osr")
    return Path(root).expanduser()


def is_memory_mapped(data: TensorDictBase) -> bool:
    """Return whether a data set's rows are read from disk when they are drawn."""
    return isinstance(data.get("observation", None), MemoryMappedTensor)


def is_memmap_folder(folder: Any) -> TypeGuard[Path | str]:
    """Return whether :func:`load_memmap` reads this path."""
    named = isinstance(folder, (str, Path))
    return named and (Path(folder).expanduser() / MANIFEST).is_file()


def write_memmap(
    chunks: Iterable[TensorDict],
    folder: Path | str,
    *,
    describe: Callable[[], Mapping[str, Any]] = dict,
) -> Dataset:
    """Write transitions to a folder, chunk by chunk, and open them.

    An interrupted call leaves no data set.

    Args:
        chunks: transitions ``[n]`` each, float32. Only one is in memory at a time.
        folder: of the data set, which is made, or replaced.

    Keyword Args:
        describe: called at the end; returns JSON-compatible entries of the manifest.
    """
    folder = Path(folder).expanduser()
    if folder.exists() and not {p.name for p in folder.iterdir()} <= {MANIFEST, ROWS}:
        raise FileExistsError(
            f"{folder} is not replaced: it is no data set, or holds other files."
        )
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        parts: list[TensorDict] = []
        for chunk in chunks:
            # For this copy and the one of all parts.
            check_disk_space(partial, 2 * chunk.bytes(), "the data set")
            chunk = chunk.select(*DATASET_KEYS)
            parts.append(chunk.memmap(partial / f"part{len(parts)}"))
        if not parts:
            raise ValueError("there is no row to write; expected at least one.")
        rows = sum(len(part) for part in parts)
        stored = parts[0][:1].expand(rows).memmap_like(partial / ROWS)
        torch.cat(parts, out=stored)
        check_dataset(stored)
        for number in range(len(parts)):
            shutil.rmtree(partial / f"part{number}")
        manifest = dict(describe()) | {"format": FORMAT, "num_transitions": rows}
        manifest["rows_sha256"] = _checksum(partial / ROWS)
        write_json(partial / MANIFEST, manifest)
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return load_memmap(folder)


def load_memmap(folder: Path | str) -> Dataset:
    """Open a data set that :func:`write_memmap` has written, and check its checksum.

    Change a ``clone()`` of the rows: writing to these tensors writes to the files.
    """
    folder = Path(folder).expanduser()
    try:
        manifest = read_json(folder / MANIFEST)
        found = [manifest.get(key) for key in ("format", "rows_sha256")]
        if found != [FORMAT, _checksum(folder / ROWS)]:
            raise ValueError("its format or its checksum is wrong")
        data: TensorDict = TensorDict.load_memmap(folder / ROWS, allow_pickle=False)
    except ValueError as error:
        raise ValueError(f"{folder} is damaged: {error}. Write it again.") from error
    return data, manifest


def load_or_write(
    folder: Path,
    request: Mapping[str, Any],
    chunks: Callable[[], Iterable[TensorDict]],
    *,
    describe: Callable[[], Mapping[str, Any]] = dict,
) -> Dataset:
    """Open a cached data set; write it first if its manifest differs from ``request``.

    Processes that ask for the same data set at once wait for one of them to write it.
    """
    wanted = json.loads(json.dumps(request))  # like the manifest's: without tuples

    def load() -> Dataset:
        data, manifest = load_memmap(folder)
        if wrong := [key for key in wanted if manifest.get(key) != wanted[key]]:
            was, want = manifest.get(wrong[0]), wanted[wrong[0]]
            raise ValueError(f"its {wrong[0]} is {was!r}, wanted {want!r}.")
        return data, manifest

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
        return write_memmap(chunks(), folder, describe=lambda: {**wanted, **describe()})


def _checksum(folder: Path) -> str:
    """Return the SHA-256 of the files of the rows."""
    return checksum_of(sorted(path for path in folder.rglob("*") if path.is_file()))


def checksum_of(files: Iterable[Path]) -> str:
    """Return the SHA-256 of the contents of files, wherever they are."""
    digests = [sha256_of(path) for path in files]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


Reader = Callable[[TensorDictBase, Tensor], TensorDictBase]


class MemmapStorage(Storage):
    """Rows of a memory-mapped set as the storage of a replay buffer, read-only."""

    def __init__(
        self,
        data: TensorDictBase,
        left_out: Tensor | None,
        device: torch.device,
        read: Reader | None,
    ) -> None:
        left_out = torch.arange(0) if left_out is None else left_out
        super().__init__(len(data) - len(left_out))
        self.data, self.device, self.read = data, device, read or operator.getitem
        # Left-out rows before row i of the rest: those with at most i rows of the rest
        # before them.
        self._shifts = left_out - torch.arange(len(left_out))

    def __len__(self) -> int:
        return int(self.max_size)

    def get(self, index: Tensor) -> TensorDictBase:
        """Return rows ``[B]``."""
        index = index.cpu()
        rows = index + torch.searchsorted(self._shifts, index, right=True)
        batch = self.read(self.data, rows)
        return batch if self.device.type == "cpu" else batch.to(self.device)

    def state_dict(self) -> dict[str, Any]:
        return {}  # the rows are in their files

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        pass


def make_replay_buffer(
    data: TensorDictBase,
    *,
    batch_size: int,
    seed: int,
    left_out: Tensor | None = None,
    transform: Transform | None = None,
    device: torch.device | str | None = None,
    read: Reader | None = None,
) -> ReplayBuffer:
    """Return a replay buffer that samples a data set uniformly, with replacement.

    The batches depend on ``seed`` alone: the buffer has a generator of its own, and
    does not prefetch, because threads would make the order of the draws depend on time.
    Memory-mapped rows stay on disk; ``read`` returns them by their numbers, and those
    ``left_out``, sorted, are not drawn.
    """
    device = torch.device(device or data.device or "cpu")
    options: dict[str, Any] = {
        "batch_size": batch_size,
        "transform": transform,
        "generator": torch.Generator(device).manual_seed(seed),
    }
    if is_memory_mapped(data):
        return ReplayBuffer(
            storage=MemmapStorage(data, left_out, device, read),
            writer=ImmutableDatasetWriter(),
            collate_fn=lambda batch: batch,
            **options,
        )
    if left_out is not None or read is not None:
        raise ValueError("left_out and read are for memory-mapped data.")
    storage = LazyTensorStorage(len(data), device=device)
    buffer = ReplayBuffer(storage=storage, **options)
    buffer.extend(data.to(device))
    return buffer
