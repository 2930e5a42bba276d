"""Checkpoints of somebody else: unpacked in their place, and not without end."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import CheckpointError

from torchrl_osr.trainers.checkpoints import find_damage, safe_checkpoint


def saved(path: Path) -> torch.nn.Linear:
    network = torch.nn.Linear(3, 2)
    safe_checkpoint(network=network, history=[1]).save(path)
    return network


def rewritten(path: Path, change, **options) -> None:
    """Write an archive anew; ``change`` is given each name and content."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, content in members.items():
            archive.writestr(*change(name, content))


@pytest.fixture
def path(tmp_path) -> Path:
    path = tmp_path / "checkpoint-1.torchrl"
    saved(path)
    return path


def test_a_checkpoint_of_ours_is_whole(path):
    assert find_damage(path) is None
    network = torch.nn.Linear(3, 2)
    assert safe_checkpoint(network=network, history=[]).load(path).loaded


def test_members_that_are_compressed_are_refused(path):
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(10**7))
    assert "'zeros' is compressed" in find_damage(path)


@pytest.mark.parametrize("entry", ["path", "files"])
def test_torchrl_writes_nothing_outside_of_its_folder(path, entry):
    """Neither do we let TorchRL have it, nor would it do that."""

    def craft(name, content):
        if name != "manifest.json":
            return name, content
        manifest = json.loads(content)
        record = manifest["components"]["history"]
        record[entry] = "../out" if entry == "path" else ["../../../out"]
        return name, json.dumps(manifest)

    rewritten(path, craft)
    assert "out" in find_damage(path)
    with pytest.raises(CheckpointError, match="Unsafe archive member path"):
        safe_checkpoint(network=torch.nn.Linear(3, 2), history=[]).load(path)


@pytest.mark.parametrize("lost", ["manifest.json", "components/0001-network/state.pt"])
def test_a_member_under_another_name_is_missing(path, lost):
    """A bit of a name in the table of contents; nothing has a checksum of it."""
    with zipfile.ZipFile(path) as archive:
        assert lost in archive.namelist()
    rewritten(path, lambda name, content: (name.replace(lost, lost[:-1]), content))
    assert find_damage(path)


def test_packed_tensors_are_refused(path):
    """The tensors lie in an archive of their own, within the checkpoint's."""

    def pack(name, content):
        if not name.endswith("state.pt"):
            return name, content
        buffer = io.BytesIO(content)
        with zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("archive/data/9", bytes(10**7))
        return name, buffer.getvalue()

    rewritten(path, pack)
    assert find_damage(path) is None
    with pytest.raises(CheckpointError, match="archive/data/9' is compressed"):
        safe_checkpoint(network=torch.nn.Linear(3, 2), history=[]).load(path)


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

    rewritten(path, objects)
    with pytest.raises(CheckpointError, match="holds other things than tensors"):
        safe_checkpoint(network=torch.nn.Linear(3, 2), history=[]).load(path)
    assert not marker.exists()
