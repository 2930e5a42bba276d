"""Checkpoints: no code in them runs."""

from __future__ import annotations

import io
import zipfile

import pytest
import torch
from torchrl.checkpoint import CheckpointError

from torchrl_osr.trainers.checkpoints import (
    GlobalGenerators,
    find_damage,
    safe_checkpoint,
)


def test_tensors_are_read_weights_only(tmp_path):
    path = tmp_path / "checkpoint-1.torchrl"
    safe_checkpoint(network=torch.nn.Linear(3, 2), history=[1]).save(path)
    fresh = safe_checkpoint(network=torch.nn.Linear(3, 2), history=[])
    assert find_damage(path) is None
    assert fresh.load(path).loaded == {"network", "history"}
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if name.endswith("state.pt"):
                buffer = io.BytesIO()
                torch.save({"weight": path}, buffer)
                content = buffer.getvalue()
            archive.writestr(name, content)
    with pytest.raises(CheckpointError, match="Weights only load failed"):
        fresh.load(path)


def test_generators_continue_on_a_machine_with_other_devices():
    state = GlobalGenerators().state_dict()
    wanted = torch.rand(1)
    absent = dict.fromkeys({"torch_mps", "torch_cuda"} - set(state), state["torch_cpu"])
    GlobalGenerators().load_state_dict(state | absent)
    assert torch.rand(1) == wanted
