"""Transitions in a folder, memory-mapped: written in chunks, opened without reading.

One file a column, plain numbers row by row, as tensordict's ``MemoryMappedTensor`` has
them, and ``manifest.json``, which has each file's SHA-256. Rows are read when they are
drawn; the pages that hold them belong to the file, and the system takes them back when
memory is short. Nothing is unpickled, and no name in the manifest is opened.

Shapes: ``N`` transitions, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, NestedKey, TensorDict
from tqdm.auto import tqdm

from torchrl_osr._files import (
    check_checksum,
    check_disk_space,
    checksummed,
    read_json,
    sha256_of,
    write_json,
)
from torchrl_osr.lab.data.store.validation import (
    DATASET_KEYS,
    FLAG_KEYS,
    check_filled,
    check_rows,
    filled_keys,
)

MANIFEST = "manifest.json"
FORMAT = "torchrl-osr transitions"

# Raise it whenever the columns or what the manifest must have change.
FORMAT_VERSION = 1

FILES: dict[str, NestedKey] = {
    f"{key if isinstance(key, str) else '-'.join(key)}.memmap": key
    for key in DATASET_KEYS
}
"""Files of the columns, and where a data set has them."""


def write_memmap(
    chunks: Iterable[TensorDict],
    folder: Path | str,
    *,
    describe: Callable[[], Mapping[str, Any]] = dict,
    total: int | None = None,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Write transitions to a folder, chunk by chunk, and open them.

    They are written to a hidden folder beside, ``.<name>.partial``, which is renamed at
    the end: an interrupted call leaves no set.

    Args:
        chunks: transitions ``[n]`` each, float32. Only one is in memory at a time.
        folder: of the set, which is made, or replaced.

    Keyword Args:
        describe: called when all chunks are written; its result, JSON-compatible, is
            put into the manifest. Default: nothing.
        total: number of rows, or more, for the bar and for a look at the free space
            before the work. Default: unknown.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        What :func:`load_memmap` returns.

    Raises:
        FileExistsError: the folder is there and not one that this function has
            written, or holds other files: nothing in it is touched.
        ValueError: :func:`~torchrl_osr.lab.data.check_dataset` refuses the
        transitions, a
            chunk has another size than those before, or there are none.
        OSError: the disk is full, or cannot be written.

    Examples:
        >>> import tempfile
        >>> from torchrl_osr.lab.data import load_local_dataset, write_memmap
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     rows, _ = load_local_dataset(
        ...         "hopper", "random", num_transitions=500, cache_dir=folder
        ...     )
        ...     data, manifest = write_memmap(rows.split(200), f"{folder}/set")
        >>> bool((data == rows).all()), manifest["num_transitions"]
        (True, 500)
    """
    folder = Path(folder).expanduser()
    beside = folder.with_name(f".{folder.name}.partial")
    with suppress(OSError):
        beside.rmdir()  # if it is empty: of a call that was killed before the manifest
    for place in (folder, beside):
        _refuse_other_folders(place)
    try:
        with explained_write_errors(folder):
            _remove(beside)
            beside.mkdir(parents=True)
            write_json(beside / MANIFEST, {"format": FORMAT})  # from now on it is ours
        shapes = _write_columns(chunks, beside, folder, total, progress)
        manifest = dict(describe()) | shapes
        with explained_write_errors(folder):
            write_json(beside / MANIFEST, checksummed(manifest))
            _remove(folder)
            os.replace(beside, folder)
    except BaseException:
        _remove(beside)
        raise
    return load_memmap(folder)


def load_memmap(folder: Path | str) -> tuple[TensorDict, dict[str, Any]]:
    """Open a set that :func:`write_memmap` has written.

    Every file is read once, to compare its checksum. Afterwards rows are read when they
    are asked for.

    Args:
        folder: of the set; it may have been copied from another machine.

    Returns:
        The transitions ``[N]``, memory-mapped, and the manifest. What is written into
        these tensors is written into the files: take a ``clone()`` to change them.

    Raises:
        FileNotFoundError: there is no such set.
        ValueError: the manifest or a file is damaged; the message names it.
    """
    folder = Path(folder).expanduser()
    if not is_memmap_folder(folder):
        raise FileNotFoundError(
            f"{folder} holds no {MANIFEST}: expected a folder that write_memmap has "
            "written."
        )
    try:
        manifest = read_json(folder / MANIFEST)
        check_checksum(manifest, MANIFEST)
        version = manifest.get("format"), manifest.get("format_version")
        if version != (FORMAT, FORMAT_VERSION):
            ours = FORMAT, FORMAT_VERSION
            raise ValueError(f"its format is {version}; this version reads {ours}")
        data = TensorDict({}, [manifest["num_transitions"]])
        for name, key in FILES.items():
            data.set(key, _open_column(folder / name, key, manifest))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{folder}: {error}. Delete the folder and write it again."
        ) from error
    return data, manifest


def is_memmap_folder(folder: Path | str) -> bool:
    """Whether :func:`load_memmap` is the reader of a path."""
    return (Path(folder).expanduser() / MANIFEST).is_file()


@contextmanager
def explained_write_errors(folder: Path) -> Iterator[None]:
    """Add the folder and what to do to an error of the file system."""
    try:
        yield
    except OSError as error:
        # errno picks the subclass, so that PermissionError stays one.
        raise OSError(
            error.errno,
            f"cannot write the data set ({error.strerror}); free space, or choose "
            "another folder (TORCHRL_OSR_CACHE=/path moves the cache)",
            str(folder),
        ) from error


def _write_columns(
    chunks: Iterable[TensorDict],
    beside: Path,
    folder: Path,
    total: int | None,
    progress: bool,
) -> dict[str, Any]:
    """Append the columns to their files; return the manifest's part about them."""
    digests = {name: hashlib.sha256() for name in FILES}
    filled: set[NestedKey] = set()
    rows, sizes = 0, (0, 0)
    with (
        ExitStack() as stack,
        tqdm(
            total=total,
            desc=f"write {folder.name}",
            unit="row",
            unit_scale=True,
            disable=None if progress else True,
        ) as bar,
    ):
        files = {
            name: stack.enter_context((beside / name).open("wb")) for name in FILES
        }
        for chunk in chunks:
            check_rows(chunk)
            _check_types(chunk)
            found = chunk["observation"].shape[-1], chunk["action"].shape[-1]
            if rows and found != sizes:
                raise ValueError(
                    f"rows from {rows:,} on have {found[0]} observation and {found[1]} "
                    f"action entries; those before have {sizes[0]} and {sizes[1]}."
                )
            if not rows and total is not None:
                needed = total * chunk.bytes() // len(chunk)
                check_disk_space(folder.parent, needed, f"the data set {folder.name}")
            sizes = found
            rows += len(chunk)
            filled |= filled_keys(chunk)
            for name, key in FILES.items():
                content = chunk.get(key).numpy(force=True).tobytes()
                digests[name].update(content)
                with explained_write_errors(folder):
                    files[name].write(content)
            bar.update(len(chunk))
        if not rows:
            raise ValueError("there is no row to write; expected at least one.")
        check_filled(filled, rows)
        with explained_write_errors(folder):
            for file in files.values():
                file.flush()
                os.fsync(file.fileno())
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "num_transitions": rows,
        "observation_size": sizes[0],
        "action_size": sizes[1],
        "sha256": {name: digest.hexdigest() for name, digest in digests.items()},
    }


def _check_types(data: TensorDict) -> None:
    """Raise unless all numbers are float32: a cast might give an infinity."""
    for key in FILES.values():
        if key not in FLAG_KEYS and data.get(key).dtype != torch.float32:
            raise ValueError(
                f"{key!r} has type {data.get(key).dtype}; expected torch.float32."
            )


def _open_column(
    path: Path, key: NestedKey, manifest: Mapping[str, Any]
) -> MemoryMappedTensor:
    """Memory-map a column; raise if its file is not the one that was written."""
    last = key if isinstance(key, str) else key[-1]
    size = f"{last}_size"  # of observations and actions; of other columns 1
    shape = torch.Size([manifest["num_transitions"], manifest.get(size, 1)])
    dtype = torch.bool if key in FLAG_KEYS else torch.float32
    expected = shape.numel() * dtype.itemsize
    if not path.is_file():
        raise ValueError(f"{path.name} is missing")
    if (found := path.stat().st_size) != expected:
        raise ValueError(
            f"{path.name} has {found:,} bytes; {shape[0]:,} rows have {expected:,}"
        )
    if sha256_of(path) != manifest["sha256"][path.name]:
        raise ValueError(f"the checksum of {path.name} is wrong")
    return MemoryMappedTensor.from_filename(path, dtype=dtype, shape=shape)


def _refuse_other_folders(folder: Path) -> None:
    """Raise unless a folder can be replaced: it is not there, or all of it is ours."""
    if not os.path.lexists(folder):
        return
    reason = "it is no folder"
    if folder.is_dir() and not folder.is_symlink():
        names = {path.name for path in folder.iterdir()}
        unfinished = f".{MANIFEST}.new"  # alone: of a call that was killed right then
        strangers = sorted(names - {MANIFEST, unfinished, *FILES})
        complete = names >= FILES.keys() or names == {unfinished}
        if not strangers and (_is_ours(folder / MANIFEST) or complete):
            return
        reason = f"it has no {MANIFEST} of a data set"
        if strangers:
            reason = f"it holds {strangers[0]}"
    raise FileExistsError(
        f"{folder} is not replaced by a data set, because {reason}: choose another "
        "folder, or remove it yourself."
    )


def _is_ours(manifest: Path) -> bool:
    try:
        return read_json(manifest).get("format") == FORMAT
    except (OSError, ValueError):
        return False


def _remove(folder: Path) -> None:
    """Remove a folder of ours: its files by name, and nothing else."""
    if folder.is_dir():
        # The manifest last: until then the folder is known as ours.
        for name in (*FILES, f".{MANIFEST}.new", MANIFEST):
            (folder / name).unlink(missing_ok=True)
        folder.rmdir()
