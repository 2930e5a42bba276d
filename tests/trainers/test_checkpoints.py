"""Checkpoints: whole ones are told from damaged ones, and no code in them runs."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import CheckpointError

from torchrl_osr.trainers.checkpoints import find_damage, safe_checkpoint


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "checkpoint-1.torchrl"
    safe_checkpoint(network=torch.nn.Linear(3, 2), history=[1]).save(path)
    return path


def rewrite(path: Path, change) -> None:
    """Write an archive anew; ``change`` gets each name and content."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(*change(name, content))


def test_what_was_saved_is_loaded(path):
    assert find_damage(path) is None
    assert safe_checkpoint(network=torch.nn.Linear(3, 2), history=[]).load(path).loaded


@pytest.mark.parametrize("lost", ["manifest.json", "components/0001-network/state.pt"])
def test_a_member_under_another_name_is_missing(path, lost):
    """A bit of a name in the table of contents, which has no checksum."""
    rewrite(path, lambda name, content: (name.replace(lost, lost[:-1]), content))
    assert find_damage(path)


class Marker:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_tensors_are_read_weights_only(path, tmp_path):
    marker = tmp_path / "marker"

    def objects(name, content):
        if not name.endswith("state.pt"):
            return name, content
        buffer = io.BytesIO()
        torch.save({"weight": Marker(marker)}, buffer)
        return name, buffer.getvalue()

    rewrite(path, objects)
    with pytest.raises(CheckpointError, match="holds other things than tensors"):
        safe_checkpoint(network=torch.nn.Linear(3, 2), history=[]).load(path)
    assert not marker.exists()
