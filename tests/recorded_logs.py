"""Recorded columns, and the files that they are read from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
from pyarrow import parquet


def make_columns(rows: int = 300) -> dict[str, Any]:
    """Return episodes of 40 steps, half of which fall."""
    rng = np.random.default_rng(1)
    ends = np.arange(rows) % 40 == 39
    columns = {
        "observation": rng.normal(size=(rows, 3)).astype(np.float32),
        "action": rng.uniform(-1, 1, (rows, 2)).astype(np.float32),
        "reward": rng.normal(size=rows),
        "terminated": ends & (rng.random(rows) < 0.5),
    }
    columns["truncated"] = ends & ~columns["terminated"]
    return columns


def save(path: Path, columns: dict[str, Any]) -> Path:
    """Write columns as the ending of the path says."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
    elif path.suffix == ".parquet":
        table = {n: list(a) if a.ndim > 1 else a for n, a in columns.items()}
        parquet.write_table(pyarrow.table(table), path)
    else:
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                file[name] = column
    return path
