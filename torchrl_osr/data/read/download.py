"""One file from the network: whole and checked, or not at all."""

from __future__ import annotations

import os
import urllib.request
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock
from torchrl import torchrl_logger
from tqdm.auto import tqdm

# The largest D4RL file of the MuJoCo tasks has about 1 GB.
MAX_BYTES = 4 * 2**30
CHUNK = 2**20
TIMEOUT_SECONDS = 60


def download_file(
    url: str,
    path: Path,
    *,
    check: Callable[[Path], object],
    max_bytes: int = MAX_BYTES,
    progress: bool = True,
) -> None:
    """Fetch a file unless it is there; processes that ask at once fetch it once.

    It is written beside its place and renamed once ``check`` has accepted it.

    Args:
        url: address, ``http`` or ``https``.
        path: where the file shall be.

    Keyword Args:
        check: is given the path of the fetched file; what it raises is passed on, and
            the file is removed.
        max_bytes: a larger file is refused. Default: 4 GiB.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Raises:
        ValueError: another kind of address, or the file is too large.
        OSError: the network or the disk failed, or the file came short.
    """
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"{url!r} is no http or https address.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        if path.exists():  # another process may have fetched it in the meantime
            return
        torchrl_logger.info(f"Downloading {url} to {path}.")
        part = path.with_name(f".{path.name}.part")
        try:
            _fetch(url, part, max_bytes, progress)
            check(part)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)


def _fetch(url: str, part: Path, max_bytes: int, progress: bool) -> None:
    received = 0
    with (
        urllib.request.urlopen(url, timeout=TIMEOUT_SECONDS) as response,
        part.open("wb") as file,
    ):
        expected = int(response.headers.get("Content-Length") or 0)
        with tqdm(
            total=expected or None,
            desc="download",
            unit="B",
            unit_scale=True,
            disable=None if progress else True,
        ) as bar:
            while received <= max_bytes >= expected:
                chunk = response.read(CHUNK)
                if not chunk:
                    break
                received += len(chunk)
                file.write(chunk)
                bar.update(len(chunk))
        file.flush()
        os.fsync(file.fileno())
    if max(received, expected) > max_bytes:
        raise ValueError(
            f"{url} has more than {max_bytes:,} bytes, the most that is downloaded."
        )
    if expected and received != expected:
        raise OSError(f"{url} came short: {received:,} of {expected:,} bytes.")
