"""Recorded columns, and the files that they are read from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
from pyarrow import parquet

D4RL_NAMES = {
    "observation": "observations",
    "action": "actions",
    "reward": "rewards",
    "terminated": "terminals",
    "truncated": "timeouts",
    "next_observation": "next_observations",
}


def make_columns(rows: int = 300, *, with_next: bool = False) -> dict[str, Any]:
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
    if with_next:
        columns["next_observation"] = rng.normal(size=(rows, 3)).astype(np.float32)
    return columns


def columns_of(data: Any) -> dict[str, Any]:
    """Return the columns that transitions are read from."""
    after = data["next"]
    return {
        "observation": data["observation"].numpy(),
        "action": data["action"].numpy(),
        "reward": after["reward"][:, 0].numpy(),
        "terminated": after["terminated"][:, 0].numpy(),
        "truncated": after["truncated"][:, 0].numpy(),
        "next_observation": after["observation"].numpy(),
    }


def save(path: Path, columns: dict[str, Any], **options: Any) -> Path:
    """Write columns as the ending of the path says."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
    elif path.suffix == ".parquet":
        table = {}
        for name, column in columns.items():
            array = np.asarray(column)
            array = array.astype(array.dtype.newbyteorder("="))
            table[name] = list(array) if array.ndim > 1 else array
        parquet.write_table(pyarrow.table(table), path, **options)
    else:
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                file[name] = column
    return path


def save_d4rl(path: Path, columns: dict[str, Any]) -> Path:
    """Write columns under D4RL's names, beside others that nobody reads."""
    save(path, {D4RL_NAMES.get(name, name): each for name, each in columns.items()})
    with h5py.File(path, "a") as file:
        file["infos/qpos"] = np.zeros((len(columns["action"]), 6))
        file["metadata/algorithm"] = "SAC"
    return path
