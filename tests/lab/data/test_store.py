"""Memory-mapped sets, their cache, and replay buffers."""

from __future__ import annotations

import shutil
from collections import namedtuple

import pytest
import torch
from recorded_logs import make_columns
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr.lab.data import (
    load_memmap,
    make_replay_buffer,
    store,
    transitions_from_columns,
    write_memmap,
)
from torchrl_osr.lab.data.store import is_memory_mapped, load_or_write

ROWS = 60


def write(data, folder, size=25, **options):
    return write_memmap(data.split(size), folder, **options)


@pytest.fixture
def data():
    return transitions_from_columns(make_columns(ROWS + 1))[0]


@pytest.mark.parametrize("size", [1, 25, ROWS + 1])
def test_rows_do_not_depend_on_the_chunks(tmp_path, data, size):
    stored, manifest = write(data, tmp_path / "set", size, describe=lambda: {"a": 1})
    assert is_memory_mapped(stored)
    assert not is_memory_mapped(stored.clone())
    assert (stored == data).all()
    assert (manifest["num_transitions"], manifest["a"]) == (ROWS, 1)
    shutil.copytree(tmp_path / "set", tmp_path / "copy")
    assert (load_memmap(tmp_path / "copy")[0] == data).all()
    assert {path.name for path in tmp_path.iterdir()} == {"set", "copy"}


def test_a_set_is_replaced_and_other_folders_are_not(data, tmp_path):
    (tmp_path / ".set.partial" / "rows").mkdir(parents=True)  # of a killed process
    stored, _ = write(data, tmp_path / "set")
    assert len(write(data[:20], tmp_path / "set")[0]) == 20
    assert (stored == data).all(), "an open one keeps its rows"
    (tmp_path / "set" / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="is not replaced"):
        write(data, tmp_path / "set")
    assert (tmp_path / "set" / "notes.txt").exists()


def test_what_fails_or_is_interrupted_leaves_no_set(tmp_path, data, monkeypatch):
    def chunks():
        yield data[:30]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_memmap(chunks(), tmp_path / "set")
    usage = namedtuple("usage", "free")
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: usage(2 * 39 * 25 - 1))
        with pytest.raises(OSError, match="not enough disk space"):
            write(data, tmp_path / "set")
    data["observation"][37] = torch.nan
    with pytest.raises(ValueError, match="'observation'.* holds NaN"):
        write(data, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def load(tmp_path, data, monkeypatch):
    """Load a cached set; ``load.made`` counts how often it was made."""

    def chunks():
        load.made += 1
        return data.split(25)

    def load(**request):
        return load_or_write(tmp_path / "set", request, chunks)

    load.made, load.warnings = 0, []
    monkeypatch.setattr(torchrl_logger, "warning", load.warnings.append)
    return load


def test_a_cached_set_is_made_once_for_a_request(load, data):
    for _ in range(2):
        assert (load(seed=(1, 2))[0] == data).all()
    assert (load.made, load.warnings) == (1, [])
    load(seed=3)
    assert load.made == 2
    assert "its seed is [1, 2], wanted 3" in load.warnings[0]


@pytest.mark.parametrize(
    "name", ["rows/action.memmap", "rows/meta.json", "manifest.json"]
)
def test_a_damaged_set_is_refused_and_made_anew(load, tmp_path, name):
    load()
    path = tmp_path / "set" / name
    content = path.read_bytes()
    path.unlink()  # not into the file that is mapped
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ValueError, match=r"set is damaged: .*Write it again"):
        load_memmap(tmp_path / "set")
    load()
    assert load.made == 2
    assert "Making" in load.warnings[0]


def test_a_whole_set_is_read_without_writing(load, monkeypatch):
    load()

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
