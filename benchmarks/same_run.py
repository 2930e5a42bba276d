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
    """Return what is compared of a run: its final checkpoints and its numbers."""
    last = [
        max(each.glob("checkpoint-*.torchrl"))
        for each in sorted((folder / "checkpoint").iterdir())
    ]
    names = [str(each.relative_to(folder)) for each in last]
    return names + [name for name in NUMBERS if (folder / name).exists()]


def differences(one: Path, other: Path) -> list[str]:
    """Return the names of files and components in which two runs differ."""
    different = []
    for name in file_names(one):
        files = one / name, other / name
        if not files[1].exists():
            different.append(f"{name}: not there")
        elif name.endswith(".json"):
            mine, theirs = (json.loads(each.read_text()) for each in files)
            # Checksums of whole archives: those have the time of writing in them.
            mine.pop("checkpoints", None), theirs.pop("checkpoints", None)
            different += [name] * (mine != theirs)
        else:
            mine, theirs = (states(each) for each in files)
            different += [
                f"{name}: {key}"
                for key in sorted(mine.keys() | theirs.keys())
                if not same(mine.get(key), theirs.get(key))
            ]
    return different


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
