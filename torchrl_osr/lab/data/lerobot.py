"""LeRobot data sets of version 3, a folder with several episodes in a Parquet file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from glob import escape
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_osr._files import read_json
from torchrl_osr.lab.data.columns import Columns, Reading, convert
from torchrl_osr.lab.data.store import Dataset
from torchrl_osr.lab.data.table import log_files, log_parts

KNOWN_NAMES = {
    "observation": ("observation.state", "observation.environment_state"),
    "action": ("action",),
    "reward": ("next.reward",),
    "terminated": ("next.success",),
    "truncated": ("next.truncated",),
    "episode": ("episode_index",),
    "step": ("frame_index",),
}
"""Columns by their part, where a set has them and the user names no others."""


def read_lerobot(path: Any, columns: Mapping[str, Any], options: Reading) -> Dataset:
    """Return transitions of a LeRobot set and manifest; ``columns`` names its parts.

    Every episode ends in its last row, and ``next.done`` does not say why. It is
    terminated there if ``next.truncated`` is false or, in a set without that column,
    ``next.success`` is true. A column that the user names takes their place.
    """
    folder = Path(path).expanduser().absolute()
    info = read_json(folder / "meta" / "info.json")
    if not (version := str(info.get("codebase_version"))).startswith("v3."):
        raise ValueError(
            f"{folder} has LeRobot's format {version}; expected v3.0. Convert a copy: "
            "'python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=any/name "
            "--root=<copy> --push-to-hub=false'."
        )
    features = info["features"]
    known: dict[str, Any] = {
        part: there
        for part, names in KNOWN_NAMES.items()
        if (there := [name for name in names if name in features])
    }
    flag, other = "terminated", "truncated"
    if "truncated" in {**known, **columns} and "terminated" not in columns:
        flag, other, known["terminated"] = other, flag, False
    about: dict[str, Any] = {"source": "lerobot", "path": str(folder)}
    about["entry_names"] = {name: _entry_names(each) for name, each in features.items()}
    cameras = [n for n, each in features.items() if each["dtype"] in ("video", "image")]
    if cameras:
        about["warnings"] = [f"images and videos are left out: {', '.join(cameras)}."]
    files = log_files(escape(str(folder)) + "/data/chunk-*/file-*.parquet")

    def parts() -> Iterator[tuple[str, Columns]]:
        total = 0
        for place, rows in log_parts(files, {**known, **columns}, about):
            last = np.r_[np.diff(rows["episode"]) != 0, True]
            ends = np.where(last, np.reshape(rows[flag], -1), 0)
            total += len(last)
            yield place, {**rows, flag: ends, other: last & (ends != 1)}
        if total != info["total_frames"]:
            raise ValueError(
                f"{folder} holds {total:,} rows where meta/info.json says "
                f"{info['total_frames']:,}: copy the whole folder again."
            )

    return convert(parts(), options, about, files)


def _entry_names(feature: Mapping[str, Any]) -> list[str]:
    """Return the names of a vector's entries, or none."""
    names: Any = feature.get("names") or []
    groups = [*names.values()] if isinstance(names, dict) else [names]
    if not all(isinstance(group, list) for group in groups):
        return [*names]  # {"x": 0, "y": 1}
    return [*chain(*groups)]  # {"motors": ["pan", "lift"]}
