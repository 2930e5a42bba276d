"""Room on the disk, looked for before hours of work and not after them."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path


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
        >>> from torchrl_osr.disk_space import check_disk_space
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
