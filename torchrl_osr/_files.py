"""Files: written whole or not at all, read within bounds, room looked for first."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

# Results of 10,000 pairs of episodes at ten levels have 40 MB.
MAX_JSON_BYTES = 256 * 2**20

# What a small archive may become in memory; a million rows of humanoid have 3 GB.
MAX_UNPACKED_BYTES = 4 * 2**30


def read_text(path: Path, *, max_bytes: int = MAX_JSON_BYTES) -> str:
    """Read a small text file, and not more of it than that.

    Args:
        path: the file.

    Keyword Args:
        max_bytes: a larger file is refused. Default: 256 MiB.

    Raises:
        OSError: it cannot be read.
        ValueError: it is too large, or no UTF-8.
    """
    size = path.stat().st_size
    if size <= max_bytes:
        with path.open("rb") as file:
            # A pipe or a file that grows has more than its size says.
            content = file.read(max_bytes + 1)
        size = len(content)
    if size > max_bytes:
        raise ValueError(f"{path.name} has more than {max_bytes:,} bytes")
    return content.decode("utf-8")


def read_json(path: Path, *, max_bytes: int = MAX_JSON_BYTES) -> dict[str, Any]:
    """Read a JSON object.

    Args:
        path: the file.

    Keyword Args:
        max_bytes: see :func:`read_text`.

    Raises:
        OSError: it cannot be read.
        ValueError: it holds something else or is too large, naming the file.
    """
    return parse_json(read_text(path, max_bytes=max_bytes), path.name)


def parse_json(text: str, name: str) -> dict[str, Any]:
    """Return the JSON object that a file holds.

    Args:
        text: of the file.
        name: of the file, for the message.

    Raises:
        ValueError: it holds something else, naming the file.
    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name} is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{name} holds no object")
    return value


def read_arrays(
    file: IO[bytes], *, max_bytes: int = MAX_UNPACKED_BYTES
) -> dict[str, NDArray[Any]]:
    """Return the plain arrays of a NumPy archive; nothing is unpickled.

    Args:
        file: the archive, opened.

    Keyword Args:
        max_bytes: see :func:`refuse_archive`.

    Raises:
        OSError: it cannot be read.
        ValueError: no archive, a damaged one, one that would unpack to too much, or an
            array of objects.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            refuse_archive(archive, max_bytes=max_bytes)
            return {
                name.removesuffix(".npy"): _read_array(archive, name)
                for name in archive.namelist()
            }
    except (MemoryError, OverflowError) as error:
        raise ValueError("an array announces more rows than there are") from error
    except (EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(str(error)) from error


def _read_array(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with archive.open(name) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
        return array


def refuse_archive(archive: zipfile.ZipFile, *, max_bytes: int = 0) -> None:
    """Raise if a ZIP archive unpacks to more than it may, or to another place.

    Args:
        archive: opened; nothing but its table of contents is looked at. No more than
            the sizes in there is ever unpacked.

    Keyword Args:
        max_bytes: that all members may have together, however well they are packed.
            What is stored unpacked always may: those bytes are in the file. Default:
            0, only what is stored so.

    Raises:
        ValueError: naming the member, or both sizes.
    """
    members = archive.infolist()
    for member in members:
        names = PurePosixPath(member.filename), PureWindowsPath(member.filename)
        if any(".." in name.parts or name.anchor for name in names):
            raise ValueError(f"the path {member.filename!r} leads out of the archive")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise ValueError(f"{member.filename!r} is a symbolic link")
    assert archive.fp is not None
    packed = archive.fp.seek(0, 2)
    refuse_size(packed, sum(member.file_size for member in members), max_bytes)


def refuse_size(
    packed: int, unpacked: int, max_bytes: int = MAX_UNPACKED_BYTES
) -> None:
    """Raise if a file would unpack to more than it may.

    Args:
        packed: bytes of the file; as many always may.
        unpacked: what its contents announce.
        max_bytes: that are allowed, however well they are packed. Default: 4 GiB.

    Raises:
        ValueError: naming both sizes.
    """
    if unpacked > max(packed, max_bytes):
        raise ValueError(
            f"it has {packed:,} bytes and would unpack to {unpacked:,}; at most "
            f"{max(packed, max_bytes):,} are read, more only without compression"
        )


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader finds the old one or the new one, never a part.

    Raises:
        OSError: naming ``path``, if it cannot be written.
    """
    beside = path.with_name(f".{path.name}.new")
    try:
        with beside.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise OSError(
            error.errno, f"cannot write the run's file ({error.strerror})", str(path)
        ) from error


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON, atomically; refuse NaN, which is not JSON."""
    write_atomically(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def check_disk_space(folder: Path | str, needed_bytes: int, what: str) -> None:
    """Raise unless a folder's disk has room.

    A disk that other programs fill later is not foreseen.

    Args:
        folder: need not be there yet.
        needed_bytes: how much will be written.
        what: shall be written, in words.

    Raises:
        OSError: ``ENOSPC``, with what is needed, what is free and what to do.

    Examples:
        >>> import tempfile
        >>> from torchrl_osr._files import check_disk_space
        >>> check_disk_space(tempfile.gettempdir(), 1, "one byte")
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
    """Return a number of bytes in the unit that people use."""
    for power, unit in ((3, "GB"), (2, "MB"), (1, "kB")):
        if size >= 1000**power:
            return f"{size / 1000**power:.1f} {unit}"
    return f"{size} bytes"
