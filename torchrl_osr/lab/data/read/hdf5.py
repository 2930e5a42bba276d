"""Arrays at the root of an HDF5 file, read in slices; never from another file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from torchrl_osr._extras import needed_by
from torchrl_osr._files import check_unpacked_size, refuse_other_than_files
from torchrl_osr.lab.data.read.recording import ReadRows
from torchrl_osr.lab.data.read.table import Table

with needed_by("HDF5 files need", "minari"):
    import h5py


def open_hdf5(path: Path) -> Table:
    """Arrays at the root of an HDF5 file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no HDF5 file or damaged, or something in it leads into another
            file; when columns are selected, if one is no array; when rows are read, if
            they have more than both 4 GiB and the file's own size. Unequal lengths are
            not looked for.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: give the path of one.")
    with _opened(path) as file:
        _check_links(path, file)
        names = list(file)

    def select(chosen: list[str]) -> tuple[int, ReadRows]:
        with _opened(path) as file:
            for name in chosen:
                if not isinstance(file[name], h5py.Dataset) or not file[name].ndim:
                    raise ValueError(
                        f"{path}: {name!r} is no array with rows; expected one."
                    )
            rows = max((len(file[name]) for name in chosen), default=0)

        def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
            with _opened(path) as file:
                arrays = [file[name] for name in chosen]
                row_bytes = sum(each.nbytes // max(len(each), 1) for each in arrays)
                check_unpacked_size(path, row_bytes * (stop - start))
                return {name: file[name][start:stop] for name in chosen}

        return rows, read

    return Table(names, select)


def check_hdf5(path: Path) -> None:
    """Raise unless a file can be read whole, on its own.

    Raises:
        ValueError: it is no HDF5 file or damaged, announces more than both 4 GiB and
            its own size, or leads into another file.
    """
    with _opened(path) as file:
        _check_links(path, file)
        sizes: list[int] = []
        file.visititems(lambda _, node: sizes.append(getattr(node, "nbytes", 0)))
        check_unpacked_size(path, sum(sizes))


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    refuse_other_than_files(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(
            f"{path} is no HDF5 file, or damaged ({error}): take a whole copy of it."
        ) from error


def _check_links(path: Path, file: h5py.File) -> None:
    """Raise if anything in a file, however it is linked, lies in another one."""
    elsewhere: list[str] = []

    def look_at_link(name: str, link: Any) -> None:
        # A soft link to an external one is found here too: that one is in this file.
        if isinstance(link, h5py.ExternalLink):
            elsewhere.append(name)

    def look_at(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and (node.external or node.is_virtual):
            elsewhere.append(name)

    file.visititems_links(look_at_link)
    file.visititems(look_at)
    if elsewhere:
        raise ValueError(
            f"{path}: {elsewhere[0]!r} leads into another file; take a copy in which "
            "the array itself is."
        )
