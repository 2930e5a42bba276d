"""Memory-mapped sets, their cache, and replay buffers."""

from __future__ import annotations

import shutil
from collections import namedtuple

import pytest
import torch
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_osr.lab.data import load_memmap, make_replay_buffer, store, write_memmap
from torchrl_osr.lab.data.rows import held_out_rows, split_held_out
from torchrl_osr.lab.data.store import is_memory_mapped, load_or_write

ROWS = 60


def write(data, folder, size=25, **options):
    return write_memmap(data.split(size), folder, progress=False, **options)


@pytest.fixture
def data(make_transitions):
    return make_transitions(ROWS)


@pytest.fixture
def folder(data, tmp_path):
    write(data, tmp_path / "set")
    return tmp_path / "set"


@pytest.mark.parametrize("size", [1, 25, ROWS, ROWS + 1])
def test_rows_do_not_depend_on_the_chunks(tmp_path, data, size):
    stored, manifest = write(data, tmp_path / "set", size, describe=lambda: {"a": 1})
    assert is_memory_mapped(stored)
    assert not is_memory_mapped(stored.clone())
    assert (stored == data).all()
    assert (manifest["num_transitions"], manifest["a"]) == (ROWS, 1)
    _, other = write(data, tmp_path / "whole", ROWS)
    assert manifest["rows_sha256"] == other["rows_sha256"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set", "whole"]


def test_a_set_is_opened_again_and_elsewhere(folder, data, tmp_path):
    rows = torch.tensor([3, 59, 0, 3])
    shutil.copytree(folder, tmp_path / "copy")
    for place in (folder, tmp_path / "copy"):
        assert (load_memmap(place)[0][rows] == data[rows]).all()
    assert (TensorDict.load_memmap(folder / "rows") == data).all()


def test_an_interrupted_call_leaves_no_set(data, tmp_path):
    def chunks():
        yield data[:30]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_memmap(chunks(), tmp_path / "set", progress=False)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".set.partial" / "rows").mkdir(parents=True)  # of a killed one
    assert (write(data, tmp_path / "set")[0] == data).all()
    assert not (tmp_path / ".set.partial").exists()


def test_a_set_is_replaced_and_other_folders_are_not(folder, data, tmp_path):
    stored, _ = load_memmap(folder)
    assert len(write(data[:20], folder)[0]) == 20
    assert (stored == data).all(), "an open one keeps its rows"
    (folder / "notes.txt").write_text("mine")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    for place in (folder, tmp_path / "thesis"):
        with pytest.raises(FileExistsError, match="is not replaced"):
            write(data, place)
    assert (folder / "notes.txt").exists()


def test_bad_rows_are_not_written(tmp_path, data):
    data["observation"][37] = torch.nan
    with pytest.raises(ValueError, match="'observation' holds NaN"):
        write(data, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_chunks_have_rows_of_one_size(tmp_path, make_transitions):
    chunks = [make_transitions(), make_transitions(sizes=(3, 5))]
    with pytest.raises(ValueError, match="rows from 60 on have other sizes"):
        write_memmap(chunks, tmp_path / "set", progress=False)
    with pytest.raises(ValueError, match="there is no row to write"):
        write_memmap([], tmp_path / "set", progress=False)
    zero = make_transitions()
    zero["action"][:20] = 0  # one chunk of it may be zero
    assert len(write(zero, tmp_path / "set", 10)[0]) == ROWS


def test_free_space_is_checked_before_the_work(tmp_path, data, monkeypatch):
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10_000 * 39 - 1))
    with pytest.raises(OSError, match="not enough disk space"):
        write(data, tmp_path / "set", total=10_000)
    assert len(write(data, tmp_path / "set", total=ROWS)[0]) == ROWS


@pytest.fixture
def load(tmp_path, data, monkeypatch):
    """Load a cached set; ``load.made`` counts how often it was made."""

    def chunks():
        load.made += 1
        return data.split(25)

    def load(**request):
        return load_or_write(tmp_path / "set", request, chunks, progress=False)

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
    ("name", "damage"),
    [
        ("rows/action.memmap", lambda content: content[:-1] + bytes([content[-1] ^ 1])),
        ("rows/meta.json", lambda content: content[:50]),
        ("manifest.json", lambda content: content[:50]),
    ],
)
def test_a_damaged_set_is_refused_and_made_anew(load, tmp_path, name, damage):
    load()
    path = tmp_path / "set" / name
    content = path.read_bytes()
    path.unlink()  # not into the file that is mapped
    path.write_bytes(damage(content))
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


def numbered_rows(rows: int) -> TensorDict:
    observation = torch.arange(rows, dtype=torch.float32)[:, None].repeat(1, 2)
    following = TensorDict({"observation": observation + 1}, [rows])
    return TensorDict({"observation": observation, "next": following}, [rows])


def draws(buffer, batches: int) -> torch.Tensor:
    return torch.cat([buffer.sample()["observation"][:, 0] for _ in range(batches)])


def test_batches_depend_on_the_seed_alone() -> None:
    data = numbered_rows(50)
    first = draws(make_replay_buffer(data, batch_size=16, seed=3), 4)
    torch.manual_seed(123)
    second = draws(make_replay_buffer(data, batch_size=16, seed=3), 4)
    other = draws(make_replay_buffer(data, batch_size=16, seed=4), 4)
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_sampling_is_uniform_with_replacement() -> None:
    buffer = make_replay_buffer(numbered_rows(10), batch_size=1000, seed=0)
    counts = torch.bincount(draws(buffer, 10).long(), minlength=10)
    # Expected 1000 each with a standard deviation of 30.
    assert counts.min() > 850
    assert counts.max() < 1150


@pytest.fixture
def both(make_transitions, tmp_path):
    """The same rows in memory and memory-mapped."""
    data = make_transitions(200)
    return data, write_memmap([data], tmp_path / "set", progress=False)[0]


def test_the_same_seed_draws_the_same_rows_from_disk(both) -> None:
    buffers = [make_replay_buffer(each, batch_size=32, seed=3) for each in both]
    for _ in range(10):
        here, there = (buffer.sample() for buffer in buffers)
        assert (here == there).all()
    assert len(buffers[1]) == 200
    with pytest.raises(RuntimeError):
        buffers[1].extend(both[0])


@pytest.mark.parametrize("held_out", [1, 7, 0.2, 199])
def test_rows_on_disk_that_are_left_out(both, held_out) -> None:
    data, stored = both
    left_out = held_out_rows(200, held_out, seed=1).sort().values
    train, rest = split_held_out(data, held_out, seed=1)
    assert (stored[left_out] == rest).all()
    buffer = make_replay_buffer(stored, batch_size=32, seed=3, left_out=left_out)
    same = make_replay_buffer(train, batch_size=32, seed=3)
    assert len(buffer) == len(train)
    for _ in range(20):
        assert (buffer.sample() == same.sample()).all()
    with pytest.raises(ValueError, match="for memory-mapped data"):
        make_replay_buffer(data, batch_size=32, seed=3, left_out=left_out)
