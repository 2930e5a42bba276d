"""The arrays of an HDF5 file, by name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from torchrl_osr._files import refuse_size

try:
    import h5py
except ImportError as error:
    raise ImportError(
        f"HDF5 files need {error.name!r}: pip install torchrl-osr[minari]"
    ) from error


def read_hdf5(
    path: Path, names: Iterable[str] | None = None
) -> dict[str, NDArray[Any]]:
    """Return the arrays at the root of an HDF5 file.

    Args:
        path: the file.
        names: which to read if they are there. Default: all, and then anything that
            is not an array is an error.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no HDF5 file or damaged, unpacks to more than both 4 GiB and
            its own size, or a name is a group or leads into another file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    try:
        with h5py.File(path, "r") as file:
            chosen = [n for n in file if n in set(names)] if names else list(file)
            _check(path, file)
            for name in chosen:
                if not isinstance(file[name], h5py.Dataset):
                    raise ValueError(f"{path}: {name!r} is a group; expected an array.")
            return {name: file[name][()] for name in chosen}
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} is no HDF5 file, or damaged: {error}") from error


def check_hdf5(path: Path) -> None:
    """Raise unless a file can be read whole, on its own.

    Args:
        path: the file.

    Raises:
        ValueError: it is no HDF5 file or damaged, unpacks to more than both 4 GiB and
            its own size, or leads into another file.
    """
    try:
        with h5py.File(path, "r") as file:
            _check(path, file)
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} is no HDF5 file, or damaged: {error}") from error


def _check(path: Path, file: h5py.File) -> None:
    elsewhere: list[str] = []
    unpacked = 0

    def look_at_link(name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            elsewhere.append(name)

    def look_at(name: str, node: Any) -> None:
        nonlocal unpacked
        if isinstance(node, h5py.Dataset):
            unpacked += node.nbytes
            if node.external or node.is_virtual:
                elsewhere.append(name)

    file.visititems_links(look_at_link)
    file.visititems(look_at)
    if elsewhere:
        raise ValueError(f"{path}: {elsewhere[0]!r} leads into another file.")
    try:
        refuse_size(path.stat().st_size, unpacked)
    except ValueError as error:
        raise ValueError(f"{path} is not read: {error}") from error
