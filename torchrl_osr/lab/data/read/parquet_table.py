"""Parquet files, read by their row groups."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr._extras import needed_by
from torchrl_osr._files import check_unpacked_size
from torchrl_osr.lab.data.read.recording import ReadRows
from torchrl_osr.lab.data.read.table import Table

with needed_by("Parquet files need", "minari"):
    import pyarrow
    from pyarrow import parquet


def open_parquet(path: Path) -> Table:
    """Columns of a Parquet file.

    Raises:
        ValueError: it is no such file or damaged, two columns have one name, or, when
            rows are read, they have more than both 4 GiB and the file's own size.
    """
    try:
        file = parquet.ParquetFile(path)
        metadata = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise ValueError(
            f"{path} is no Parquet file, or damaged ({error}): take a whole copy of it."
        ) from error
    names = file.schema_arrow.names
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{path}: two columns are called {twice[0]!r}; expected one.")
    bounds = np.cumsum([0, *(group.num_rows for group in metadata)])

    def select(chosen: list[str]) -> tuple[int, ReadRows]:
        sizes = [8 * _number_of_values(each, chosen) for each in metadata]

        @lru_cache(maxsize=1)  # the next part may begin in the last group of this one
        def group(number: int) -> Any:
            try:
                return file.read_row_group(number, columns=chosen)
            except (pyarrow.ArrowException, OSError) as error:
                raise ValueError(
                    f"{path} is damaged ({error}): take a whole copy of it."
                ) from error

        def read(start: int, stop: int) -> dict[str, NDArray[Any]]:
            first = int(np.searchsorted(bounds, start, side="right")) - 1
            last = int(np.searchsorted(bounds, stop, side="left"))
            check_unpacked_size(path, sum(sizes[first:last]))
            groups = [group(number) for number in range(first, last)]
            empty = file.schema_arrow.empty_table().select(chosen)
            table = pyarrow.concat_tables([empty, *(g.select(chosen) for g in groups)])
            table = table.slice(start - bounds[first], stop - start)
            return {name: _as_numpy(name, table[name]) for name in chosen}

        return int(bounds[-1]), read

    return Table(names, select)


def _number_of_values(group: Any, names: list[str]) -> int:
    """Numbers in some columns of a row group; of lists, their entries count."""
    parts = [group.column(i) for i in range(group.num_columns)]
    inner = tuple(f"{name}." for name in names)  # entries of a list
    return sum(
        int(part.num_values)
        for part in parts
        if part.path_in_schema in names or part.path_in_schema.startswith(inner)
    )


def _as_numpy(name: str, column: Any) -> NDArray[Any]:
    """Parquet column ``[N]``, or ``[N, D]`` if it holds lists."""
    if column.null_count:
        row = int(np.flatnonzero(column.is_null())[0])
        raise ValueError(f"{name!r} has no value in row {row}: repair or remove it.")
    kinds = pyarrow.types
    if not any(
        is_kind(column.type)
        for is_kind in (kinds.is_list, kinds.is_large_list, kinds.is_fixed_size_list)
    ):
        return np.asarray(column.to_numpy())
    lengths = column.combine_chunks().value_lengths().to_numpy(zero_copy_only=False)
    sizes, first = np.unique(lengths, return_index=True)
    if len(sizes) > 1:
        raise ValueError(
            f"{name!r} has lists of unequal length: {sizes[0]} numbers in row "
            f"{first[0]}, {sizes[1]} in row {first[1]}."
        )
    values = column.combine_chunks().flatten()
    if values.null_count:
        entry = int(np.flatnonzero(values.is_null())[0])
        row = entry // int(sizes[0])
        raise ValueError(f"{name!r} has no value in row {row}: repair or remove it.")
    flat = np.asarray(values.to_numpy(zero_copy_only=False))
    return flat.reshape(len(column), -1) if len(column) else flat.reshape(0, 1)
