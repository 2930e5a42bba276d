"""The arrays of an HDF5 file, by name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

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
        ValueError: it is no HDF5 file or damaged, or a name is a group.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    try:
        with h5py.File(path, "r") as file:
            chosen = [n for n in file if n in set(names)] if names else list(file)
            for name in chosen:
                if not isinstance(file[name], h5py.Dataset):
                    raise ValueError(f"{path}: {name!r} is a group; expected an array.")
            return {name: file[name][()] for name in chosen}
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} is no HDF5 file, or damaged: {error}") from error
