"""The cache of rolled-out sets, and replay buffers."""

from __future__ import annotations

import pytest
import torch
from recorded_logs import make_columns
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr.lab.data import make_replay_buffer, store, transitions_from_columns
from torchrl_osr.lab.data.store import load_or_write


@pytest.fixture
def data():
    return transitions_from_columns(make_columns(61))[0]


@pytest.fixture
def load(tmp_path, data, monkeypatch):
    """Load a cached set; ``load.made`` counts how often it was made."""

    def make():
        load.made += 1
        return data, {"a": 1}

    def load(**request):
        return load_or_write(tmp_path / "set.safetensors", request, make)

    load.made, load.warnings = 0, []
    monkeypatch.setattr(torchrl_logger, "warning", load.warnings.append)
    return load


def test_a_cached_set_is_made_once_for_a_request(load, data, tmp_path):
    (tmp_path / ".set.safetensors.new").write_bytes(b"0")  # of a killed process
    for _ in range(2):
        found, manifest = load(seed=(1, 2))
        assert (found == data).all()
        assert (manifest["num_transitions"], manifest["a"]) == (60, 1)
    assert (load.made, load.warnings) == (1, [])
    load(seed=3)
    assert load.made == 2
    assert "its seed is [1, 2], wanted 3" in load.warnings[0]
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"set.safetensors", "set.safetensors.lock"}


def test_what_fails_leaves_no_set(load, data, tmp_path):
    data["observation"][37] = torch.nan
    with pytest.raises(ValueError, match="'observation'.* holds NaN"):
        load()
    assert [path.name for path in tmp_path.iterdir()] == ["set.safetensors.lock"]


def test_a_damaged_set_is_made_anew_and_a_whole_one_read(load, tmp_path, monkeypatch):
    load()
    path = tmp_path / "set.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    load()
    assert load.made == 2
    assert "Making" in load.warnings[0]

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(store, "FileLock", refuse)
    load()
    with pytest.raises(PermissionError):
        load(another="request")


def test_sampling_is_uniform_with_replacement_and_depends_on_the_seed_alone() -> None:
    data = TensorDict({"row": torch.arange(10)}, [10])

    def draws(seed: int) -> torch.Tensor:
        return make_replay_buffer(data, batch_size=10_000, seed=seed).sample()["row"]

    rows = draws(0)
    # Expected 1000 each with a standard deviation of 30.
    counts = torch.bincount(rows, minlength=10)
    assert counts.min() > 850
    assert counts.max() < 1150
    torch.manual_seed(123)
    assert torch.equal(draws(0), rows)
    assert not torch.equal(draws(1), rows)
