"""Sets on disk by what a configuration names: the same rows as in memory."""

from __future__ import annotations

import os

import h5py
import numpy as np
import pytest
import torch

from torchrl_osr.data import disk_cache, load_dataset, write_on_disk

OPTIONS = {"progress": False, "random_share": 0.0}


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path / "cache"))


def write_log(path, seed=0):
    rng = np.random.default_rng(seed)
    ends = np.arange(500) % 50 == 49
    with h5py.File(path, "w") as file:
        file["observations"] = rng.normal(size=(500, 11)).astype(np.float32)
        file["actions"] = rng.uniform(-1, 1, (500, 3)).astype(np.float32)
        file["rewards"] = rng.normal(size=500)
        file["terminals"] = ends & (rng.random(500) < 0.5)
        file["timeouts"] = ends & ~file["terminals"][()]


def both(*args, **options):
    """Return rows and manifest, from memory and from disk."""
    data, manifest = load_dataset(*args, **OPTIONS, **options)
    stored, described = load_dataset(*args, **OPTIONS, **options, on_disk=True)
    assert len(stored) == len(data)
    return data, manifest, stored[torch.arange(len(stored))], described


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_levels(share, monkeypatch):
    monkeypatch.setattr(disk_cache, "SLICE_ROWS", 130)
    options = {"num_transitions": 400, "seed": 1, "progress": False}
    options["random_share"] = share
    data, manifest = load_dataset("hopper", "medium", **options)
    stored, described = load_dataset("hopper", "medium", **options, on_disk=True)
    assert (stored[torch.arange(400)] == data).all()
    assert described["normalized_score"] == manifest["normalized_score"]
    # Neither collected nor read again.
    monkeypatch.setattr(disk_cache, "load_mixture", None)
    again, _ = load_dataset("hopper", "medium", **options, on_disk=True)
    assert len(again) == 400


def test_recorded_data_and_what_follows_a_change(tmp_path):
    path = tmp_path / "set.hdf5"
    write_log(path)
    options = {"env_id": "Hopper-v5", "path": str(path)}
    data, manifest, rows, described = both("hopper", "d4rl", **options)
    assert (rows == data).all()
    for name in ("normalized_score", "return", "dropped_rows", "source", "level"):
        assert described[name] == manifest[name]
    folders = list((tmp_path / "cache" / "on-disk").glob("d4rl-*[!k]"))
    before = (folders[0] / "rows.bin").stat().st_mtime_ns
    both("hopper", "d4rl", **options)
    assert (folders[0] / "rows.bin").stat().st_mtime_ns == before
    write_log(path, seed=1)
    os.utime(path, ns=(0, 0))  # clocks may be coarse
    data, _, rows, _ = both("hopper", "d4rl", **options)
    assert (rows == data).all()
    options["env_id"] = "HalfCheetah-v5"
    with pytest.raises(ValueError, match="has 11 observation and 3 action entries"):
        load_dataset("halfcheetah", "d4rl", **OPTIONS, **options, on_disk=True)


def test_a_set_that_was_written_by_hand(tmp_path):
    data, _ = load_dataset("hopper", "random", num_transitions=300, seed=0, **OPTIONS)
    folder = str(tmp_path / "mine")
    write_on_disk(lambda done: [(data, {})], folder, progress=False)
    stored, manifest = load_dataset(
        "hopper", "file", env_id="Hopper-v5", path=folder, on_disk=True, **OPTIONS
    )
    assert (stored[torch.arange(300)] == data).all()
    assert manifest["normalized_score"] is None
    with pytest.raises(ValueError, match="must end in one of"):
        load_dataset("hopper", "file", path=folder, **OPTIONS)


def test_an_archive_is_not_read_as_a_whole_in_secret(tmp_path):
    np.savez(tmp_path / "log.npz", reward=np.zeros(3))
    with pytest.raises(ValueError, match=r"cannot be read slice by slice"):
        load_dataset(
            "hopper", "file", path=str(tmp_path / "log.npz"), on_disk=True, **OPTIONS
        )
