"""Memory-mapped sets: the same rows, whole or not at all, and nobody else's folders."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_osr._files import checksummed
from torchrl_osr.lab.data import is_memory_mapped, load_memmap, write_memmap

ROWS = 60


def write(data, folder, size=25, **options):
    return write_memmap(data.split(size), folder, progress=False, **options)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def data(make_transitions):
    return make_transitions(ROWS)


@pytest.fixture
def folder(data, tmp_path):
    write(data, tmp_path / "set")
    return tmp_path / "set"


@settings(max_examples=15, deadline=None, database=None, derandomize=True)
@given(size=st.integers(1, ROWS + 1))
def test_files_do_not_depend_on_the_chunks(tmp_path_factory, make_transitions, size):
    place, data = tmp_path_factory.mktemp("written"), make_transitions(ROWS)
    stored, manifest = write(data, place / "set", size, describe=lambda: {"a": 1})
    assert is_memory_mapped(stored)
    assert not is_memory_mapped(stored.clone())
    assert (stored == data).all()
    assert (manifest["num_transitions"], manifest["a"]) == (ROWS, 1)
    write(data, place / "whole", ROWS, describe=lambda: {"a": 1})
    assert contents(place / "set") == contents(place / "whole")
    assert sorted(path.name for path in place.iterdir()) == ["set", "whole"]


def test_a_set_is_opened_again_and_elsewhere(folder, data, tmp_path):
    rows = torch.tensor([3, 59, 0, 3])
    shutil.copytree(folder, tmp_path / "copy")
    for place in (folder, tmp_path / "copy"):
        stored, _ = load_memmap(place)
        assert (stored[rows] == data[rows]).all()
    for path in folder.iterdir():
        path.chmod(0o444)
    assert (load_memmap(folder)[0] == data).all()


def test_an_interrupted_call_leaves_nothing_and_is_made_again(data, tmp_path):
    def chunks():
        yield data[:30]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_memmap(chunks(), tmp_path / "set", progress=False)
    assert list(tmp_path.iterdir()) == []
    assert (write(data, tmp_path / "set")[0] == data).all()


KILLED = """
import os, pickle, signal, sys
import torch
from torchrl_osr.lab.data import write_memmap
data = torch.load(sys.argv[1], weights_only=False)
def chunks():
    yield data[:30]
    os.kill(os.getpid(), signal.SIGKILL)
write_memmap(chunks(), sys.argv[2], progress=False)
"""


def test_what_a_killed_process_leaves_is_replaced(data, tmp_path):
    torch.save(data, tmp_path / "data.pt")
    command = [sys.executable, "-c", KILLED, *map(str, (tmp_path / "data.pt", "set"))]
    killed = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert (tmp_path / ".set.partial").is_dir()
    assert not (tmp_path / "set").exists()
    assert (write(data, tmp_path / "set")[0] == data).all()
    assert not (tmp_path / ".set.partial").exists()


def test_a_set_is_replaced_by_another(folder, data):
    stored, _ = load_memmap(folder)
    again, _ = write(data[:20], folder)
    assert len(again) == 20
    assert (stored == data).all(), "who has the old one open keeps it"


def thesis(folder: Path):
    folder.mkdir()
    (folder / "thesis.tex").write_text("three years")


def foreign_manifest(folder: Path):
    folder.mkdir()
    (folder / "manifest.json").write_text('{"format": "another"}')


def set_with_notes(folder: Path):
    shutil.copytree(folder.parent / "sound", folder)
    (folder / "notes.txt").write_text("mine")


def link(folder: Path):
    thesis(folder.with_name("elsewhere"))
    folder.symlink_to(folder.with_name("elsewhere"))


@pytest.mark.parametrize("name", ["set", ".set.partial"])
@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (thesis, r"it holds thesis\.tex"),
        (foreign_manifest, r"it has no manifest\.json of a data set"),
        (set_with_notes, r"it holds notes\.txt"),
        (link, "it is no folder"),
        (lambda folder: folder.write_text("a file"), "it is no folder"),
    ],
)
def test_a_folder_of_somebody_else_is_not_touched(data, tmp_path, name, make, reason):
    write(data, tmp_path / "sound")
    make(tmp_path / name)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(FileExistsError, match=f"{name} is not replaced .*{reason}"):
        write(data, tmp_path / "set")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_call_killed_before_its_first_file_begins_again(data, tmp_path):
    (tmp_path / ".set.partial").mkdir()
    (tmp_path / ".set.partial" / ".manifest.json.new").write_text("{")
    write(data, tmp_path / "set")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_an_empty_folder_is_not_a_set_either(data, tmp_path):
    (tmp_path / "set").mkdir()
    with pytest.raises(FileExistsError, match="choose another folder"):
        write(data, tmp_path / "set")


COLUMNS = [
    *["observation", "action", "next-observation", "next-reward"],
    *["next-done", "next-terminated", "next-truncated"],
]


@pytest.mark.parametrize("name", COLUMNS)
def test_damage_is_found_at_opening_and_named(folder, name):
    path = folder / f"{name}.memmap"
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ValueError, match=rf"the checksum of {name}\.memmap is wrong"):
        load_memmap(folder)
    path.write_bytes(content[:-1])
    expected = rf"{name}\.memmap has {len(content) - 1} bytes; 60 rows have"
    with pytest.raises(ValueError, match=f"{expected}.*write it again"):
        load_memmap(folder)
    path.unlink()
    with pytest.raises(ValueError, match=rf"{name}\.memmap is missing"):
        load_memmap(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "another"}, "its format is"),
        ({"format_version": 99}, "its format is .*99"),
        ({"num_transitions": "60"}, "write it again"),
        ({"num_transitions": -60}, "write it again"),
        ({"num_transitions": 61}, "has 720 bytes; 61 rows have 732"),
        ({"observation_size": 10**15}, "has 720 bytes"),
        ({"action_size": 3}, "rows have 720"),
        ({"sha256": None}, "write it again"),
        ({"sha256": {}}, r"observation\.memmap.*write it again"),
    ],
)
def test_a_wrong_manifest_is_refused(folder, changes, message):
    path = folder / "manifest.json"
    path.write_text(json.dumps(checksummed(json.loads(path.read_text()) | changes)))
    with pytest.raises(ValueError, match=message):
        load_memmap(folder)


def test_a_changed_manifest_and_what_is_no_set_are_refused(folder, tmp_path):
    path = folder / "manifest.json"
    text = path.read_text()
    path.write_text(text.replace('"num_transitions": 60', '"num_transitions": 61'))
    with pytest.raises(ValueError, match=r"the checksum of manifest\.json is wrong"):
        load_memmap(folder)
    path.write_text("[]")
    with pytest.raises(ValueError, match="holds no object"):
        load_memmap(folder)
    with pytest.raises(FileNotFoundError, match="that write_memmap has written"):
        load_memmap(tmp_path)


def spoilt(data, key, value):
    column = data[key].clone()
    column[37] = value
    return data.set(key, column)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: spoilt(d, "observation", float("nan")), "'observation' holds NaN"),
        (lambda d: d.set("observation", d["observation"].double()), "torch.float64; e"),
        (lambda d: d.exclude("action"), "lacks 'action'"),
        (lambda d: d.set("action", torch.zeros(ROWS, 2)), "'action' is zero in all"),
        (lambda d: d.set(("next", "done"), torch.ones(ROWS, 1) > 0), "differs from"),
    ],
)
def test_what_is_no_data_set_is_refused(tmp_path, data, spoil, message):
    with pytest.raises(ValueError, match=message):
        write(spoil(data), tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_chunks_have_rows_of_one_size(tmp_path, make_transitions):
    chunks = [make_transitions(), make_transitions(sizes=(3, 5))]
    message = "from 60 on have 3 observation and 5 action entries; .* 3 and 2"
    with pytest.raises(ValueError, match=message):
        write_memmap(chunks, tmp_path / "set", progress=False)
    with pytest.raises(ValueError, match="there is no row to write"):
        write_memmap([], tmp_path / "set", progress=False)
    zero = make_transitions()
    zero["action"][:20] = 0  # one chunk of it may be zero
    assert len(write(zero, tmp_path / "set", 10)[0]) == ROWS


def test_room_is_looked_for_before_the_work(tmp_path, data, monkeypatch):
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10_000 * 39 - 1))
    with pytest.raises(OSError, match="not enough disk space"):
        write(data, tmp_path / "set", total=10_000)
    assert len(write(data, tmp_path / "set", total=ROWS)[0]) == ROWS
