"""Files: written whole or not at all, read within bounds, told apart by checksums."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO

import numpy as np
from numpy.lib.format import MAGIC_PREFIX
from numpy.typing import NDArray

# Results of 10,000 pairs of episodes at ten levels have 40 MB.
MAX_JSON_BYTES = 256 * 2**20

# What a small file may become in memory; a million rows of humanoid have 3 GB.
MAX_UNPACKED_BYTES = 4 * 2**30

CHECKSUM = "checksum"
"""Where a record has the SHA-256 of everything else in it."""


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that readers find whole, or as it was before.

    It is written beside its place, synced to the disk and renamed.

    Raises:
        OSError: naming ``path``, if it cannot be written.
    """
    beside = path.with_name(f".{path.name}.new")
    try:
        with beside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        raise OSError(
            error.errno, f"cannot write the file ({error.strerror})", str(path)
        ) from error
    finally:
        beside.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text or bytes, see :func:`whole_file`."""
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, value: Any) -> None:
    """Write JSON, see :func:`whole_file`; NaN and infinity, which it lacks, as null."""
    text = json.dumps(finite_or_none(value), indent=1, allow_nan=False)
    write_atomically(path, text + "\n")


def finite_or_none(value: Any) -> Any:
    """JSON-compatible value with ``None`` in place of every float that is not finite.

    Examples:
        >>> from torchrl_osr._files import finite_or_none
        >>> finite_or_none({"r2": [0.5, float("-inf")]})
        {'r2': [0.5, None]}
    """
    if isinstance(value, Mapping):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_text(path: Path, *, max_bytes: int = MAX_JSON_BYTES) -> str:
    """Text of a small file, of at most ``max_bytes``.

    Raises:
        OSError: it cannot be read.
        ValueError: it is too large, not UTF-8, or no file.
    """
    refuse_other_than_files(path)
    with path.open("rb") as file:
        # Not its size: a file may grow.
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ValueError(f"{path.name} has more than {max_bytes:,} bytes")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path.name} is no text: {error}") from error


def refuse_other_than_files(path: Path) -> None:
    """Raise a ValueError if a path is a folder, a named pipe or a device.

    To open a pipe waits for its other end, perhaps for ever.
    """
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is a folder, a pipe or a device; a file was expected")


def read_json(path: Path, *, max_bytes: int = MAX_JSON_BYTES) -> dict[str, Any]:
    """JSON object that a file holds, see :func:`read_text`.

    Raises:
        OSError: it cannot be read.
        ValueError: it holds something else or is too large, naming the file.
    """
    return parse_json(read_text(path, max_bytes=max_bytes), path.name)


def parse_json(text: str, name: str) -> dict[str, Any]:
    """JSON object in a text; a ValueError names the file if it is something else."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name} is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{name} holds no object")
    return value


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Plain arrays of a NumPy archive (``.npz``), by name; nothing is unpickled.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no archive, damaged, holds objects, two arrays of one name, or
            would unpack to more than :func:`check_unpacked_size` allows; the message
            names the file.
    """
    try:
        refuse_other_than_files(path)
        with path.open("rb") as file:
            if file.read(len(MAGIC_PREFIX)) == MAGIC_PREFIX:
                raise ValueError("it is a single array")
        with zipfile.ZipFile(path) as archive:
            sizes = [member.file_size for member in archive.infolist()]
            names = [name.removesuffix(".npy") for name in archive.namelist()]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two arrays in it are called {twice[0]!r}")
        check_unpacked_size(path, sum(sizes))
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive}
        # What is no array comes back as bytes.
        if others := [name for name in arrays if isinstance(arrays[name], bytes)]:
            raise ValueError(f"{others[0]!r} in it is no array")
        return arrays
    except (
        *(EOFError, MemoryError, NotImplementedError, OverflowError),
        *(ValueError, zipfile.BadZipFile, zlib.error),
    ) as error:
        raise ValueError(
            f"{path} is no NumPy archive of plain arrays, or damaged ({error}): take a "
            "whole copy of it, written with numpy.savez"
        ) from error


def check_unpacked_size(path: Path, unpacked: int) -> None:
    """Raise a ValueError if contents have more bytes than 4 GiB and the file's size."""
    most = max(path.stat().st_size, MAX_UNPACKED_BYTES)
    if unpacked > most:
        raise ValueError(
            f"{path.name} would unpack to {unpacked:,} bytes; at most {most:,} are "
            "read: store more without compression"
        )


def refuse_archive(archive: zipfile.ZipFile) -> None:
    """Raise unless a ZIP archive unpacks to its own place and its own size.

    Raises:
        ValueError: naming the member: its path leads out, it is a symbolic link, or it
            is compressed, so that a small file may unpack to anything.
    """
    for member in archive.infolist():
        names = PurePosixPath(member.filename), PureWindowsPath(member.filename)
        if any(".." in name.parts or name.anchor for name in names):
            raise ValueError(f"the path {member.filename!r} leads out of the archive")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise ValueError(f"{member.filename!r} is a symbolic link")
        if member.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"{member.filename!r} is compressed")


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def checksummed(record: Mapping[str, Any]) -> dict[str, Any]:
    """JSON-compatible record with the checksum of its contents in it.

    Examples:
        >>> from torchrl_osr._files import check_checksum, checksummed
        >>> record = checksummed({"rows": 7})
        >>> check_checksum(record, "card.json")
        >>> check_checksum(record | {"rows": 8}, "card.json")
        Traceback (most recent call last):
            ...
        ValueError: the checksum of card.json is wrong
    """
    return dict(record) | {CHECKSUM: _checksum(record)}


def check_checksum(record: Mapping[str, Any], name: str) -> None:
    """Raise a ValueError that names the file unless :func:`checksummed` made it so."""
    if record.get(CHECKSUM) != _checksum(record):
        flaw = "wrong" if CHECKSUM in record else "missing"
        raise ValueError(f"the checksum of {name} is {flaw}")


def _checksum(record: Mapping[str, Any]) -> str:
    # Sorted: the order of a JSON object's keys says nothing.
    rest = {key: value for key, value in record.items() if key != CHECKSUM}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def check_disk_space(folder: Path | str, needed_bytes: int, what: str) -> None:
    """Raise unless a folder's disk has room.

    Args:
        folder: need not be there yet.
        needed_bytes: how much will be written.
        what: will be written there, in words.

    Raises:
        OSError: ``ENOSPC``, with what is needed, what is free and what to do.
    """
    there = Path(folder).absolute()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if free < needed_bytes:
        raise OSError(
            errno.ENOSPC,
            f"not enough disk space: {_readable(needed_bytes)} are needed for {what}, "
            f"{_readable(free)} are free. Free space or choose another disk",
            str(folder),
        )


def _readable(size: int) -> str:
    """Number of bytes in the unit that people use."""
    for power, unit in ((3, "GB"), (2, "MB"), (1, "kB")):
        if size >= 1000**power:
            return f"{size / 1000**power:.1f} {unit}"
    return f"{size} bytes"
