"""Are two runs equal, bit for bit? Checkpoints and every number that they wrote."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import torch

NUMBERS = ("returns.json", "inverse_dynamics.json", "robustness-torque.json")


def file_names(folder: Path) -> list[str]:
    """Return what is compared of a run: checkpoints, numbers and rows of the log."""
    found = [*folder.glob("checkpoint/*/*.torchrl"), *folder.glob("csv/*/*/*.csv")]
    names = [path.relative_to(folder).as_posix() for path in sorted(found)]
    return names + [name for name in NUMBERS if (folder / name).exists()]


def differences(one: Path, other: Path, *, same_means: bool = False) -> list[str]:
    """Return the names of files and components in which two runs differ.

    Args:
        one: folder of a run.
        other: folder of another.

    Keyword Args:
        same_means: compare the values of the log, too, not only their steps. After an
            interrupt the first means are over the rest of their interval.
    """
    names = file_names(one)
    different = [
        f"{name}: in one of them only" for name in set(names) ^ set(file_names(other))
    ]
    for name in [each for each in names if (other / each).exists()]:
        mine, theirs = (read(folder / name, same_means) for folder in (one, other))
        different += [
            f"{name}: {key}"
            for key in sorted(mine.keys() | theirs.keys())
            if not same(mine.get(key), theirs.get(key))
        ]
    return different


def read(path: Path, same_means: bool) -> dict[str, Any]:
    """Return what is compared of a file, by key."""
    if path.suffix == ".torchrl":
        return states(path)
    if path.suffix == ".csv":
        rows = path.read_text().splitlines()
        return {"rows": rows if same_means else [row.split(",")[0] for row in rows]}
    content: dict[str, Any] = json.loads(path.read_text())
    # Checksums of whole archives: those have the time of writing in them.
    content.pop("checkpoints", None)
    content.pop("checksum", None)
    return content


def states(path: Path) -> dict[str, Any]:
    """Return every entry of a checkpoint, by its component and key."""
    result: dict[str, Any] = {}
    with zipfile.ZipFile(path) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        for name, record in manifest["components"].items():
            for member in archive.namelist():
                if not member.startswith(f"{record['path']}/"):
                    continue
                content = archive.read(member)
                if member.endswith(".pt"):
                    state = torch.load(io.BytesIO(content), weights_only=True)
                else:
                    state = {"content": content}
                # Python's and NumPy's generators are saved too, but nothing here draws
                # from them and they are not seeded.
                if name == "global_rng":
                    state = {"torch_cpu": state.get("torch_cpu")}
                result |= flat(name, state)
    return result


def flat(name: str, value: Any) -> dict[str, Any]:
    """Return nested state as one mapping."""
    if isinstance(value, (list, tuple)):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        return {name: value}
    result: dict[str, Any] = {}
    for key, item in value.items():
        result |= flat(f"{name}/{key}", item)
    return result


def same(mine: Any, theirs: Any) -> bool:
    """Return whether two states are equal bit for bit."""
    if torch.is_tensor(mine) and torch.is_tensor(theirs):
        return mine.dtype == theirs.dtype and torch.equal(mine, theirs)
    return type(mine) is type(theirs) and bool(mine == theirs)
