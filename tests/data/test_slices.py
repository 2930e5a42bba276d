"""Reading in slices gives the rows of reading at once, whatever the slices are."""

from __future__ import annotations

from functools import partial

import h5py
import numpy as np
import pyarrow
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from torchrl_osr.data import (
    export_minari,
    load_d4rl,
    load_file,
    load_local_dataset,
    load_minari,
    slices,
    transitions_from_rows,
)
from torchrl_osr.data.d4rl_reader import slices_of_d4rl
from torchrl_osr.data.file_slices import slices_of_file
from torchrl_osr.data.minari_slices import slices_of_minari
from torchrl_osr.data.slices import Slices, whole_trajectories

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")
tried = settings(
    max_examples=60,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)


@st.composite
def recordings(draw):
    """Return columns of some steps, one in ten with a flaw."""
    count = draw(st.integers(1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows = {
        "observation": rng.normal(size=(count, 2)).astype(draw(st.sampled_from("fd"))),
        "action": rng.uniform(-1, 1, (count, 1)),
        "reward": rng.normal(size=count),
        "terminated": rng.random(count) < draw(st.sampled_from([0, 0.1, 0.5])),
    }
    kinds = draw(st.sampled_from(["truncated", "episode", "both"]))
    if kinds != "episode":
        rows["truncated"] = rng.random(count) < draw(st.sampled_from([0, 0.2, 1]))
    if kinds != "truncated":
        rows["episode"] = np.cumsum(rng.random(count) < 0.2)
        if draw(st.integers(0, 9)) == 0:
            rows["episode"] %= 2  # some come back
    if draw(st.booleans()):
        rows["next_observation"] = rng.normal(size=(count, 2))
    if draw(st.integers(0, 9)) == 0:
        rows["reward"][rng.integers(count)] = np.nan
    return rows


def in_slices(opened, size, done=()):
    """Return the rows of a set that is read slice by slice, and all notes."""
    opened = opened._replace(read=partial(opened.read, size=size))
    return collected(opened, list(done))


def collected(opened, done=()):
    parts, notes = [], list(done)
    for data, note in opened.chunks(list(done)):
        parts.append(data)
        notes.append(note)
    return torch.cat(parts), notes


def assert_same(opened, size, data, manifest):
    rows, notes = in_slices(opened, size)
    assert (rows == data).all()
    described = opened.describe(notes)
    for name in described.keys() - opened.about.keys():
        assert described[name] == manifest[name], name
    returns = [each for note in notes for each in note["returns"]]
    assert returns == manifest["episode_returns"]


def opened_rows(rows):
    total = len(rows["reward"])

    def read(start, stop):
        return {name: column[start:stop] for name, column in rows.items()}

    return Slices({"source": "x"}, total, partial(whole_trajectories, read, total))


@tried
@given(rows=recordings(), size=st.integers(1, 40))
def test_any_recording_in_slices_of_any_size(rows, size):
    opened = opened_rows(rows)
    try:
        data, manifest = transitions_from_rows(rows)
    except ValueError:
        with pytest.raises(ValueError, match=r"slice|has a true next state"):
            opened.describe(in_slices(opened, size)[1])
        return
    assert_same(opened, size, data, manifest)


@tried
@given(rows=recordings(), size=st.integers(1, 10), number=st.integers(0, 5))
def test_any_slice_can_be_the_first(rows, size, number):
    opened = opened_rows(rows)
    try:
        data, notes = in_slices(opened, size)
    except ValueError:
        return
    number = min(number, len(notes) - 1)
    before = sum(note["rows"] - note["dropped_rows"] for note in notes[:number])
    rest, all_notes = in_slices(opened, size, notes[:number])
    assert (rest == data[before:]).all()
    assert all_notes == notes


def columns(count=300, *, with_next=False):
    rng = np.random.default_rng(1)
    ends = np.arange(count) % 40 == 39
    rows = {
        "observation": rng.normal(size=(count, 3)).astype(np.float32),
        "action": rng.uniform(-1, 1, (count, 2)).astype(np.float32),
        "reward": rng.normal(size=count),
        "terminated": ends & (rng.random(count) < 0.5),
    }
    rows["truncated"] = ends & ~rows["terminated"]
    if with_next:
        rows["next_observation"] = rng.normal(size=(count, 3)).astype(np.float32)
    return rows


@pytest.mark.parametrize("size", [1, 50, 1000])
@pytest.mark.parametrize("with_next", [True, False])
@pytest.mark.parametrize("ending", ["h5", "parquet"])
def test_files(tmp_path, ending, with_next, size):
    rows, path = columns(with_next=with_next), tmp_path / f"log.{ending}"
    if ending == "h5":
        with h5py.File(path, "w") as file:
            for name, column in rows.items():
                file[name] = column
    else:
        lists = {n: c.tolist() if c.ndim == 2 else c for n, c in rows.items()}
        parquet.write_table(pyarrow.table(lists), path, row_group_size=70)
    assert_same(slices_of_file(path), size, *load_file(path))


@pytest.mark.parametrize("size", [1, 50, 1000])
@pytest.mark.parametrize("limit", [None, 10])
def test_d4rl(tmp_path, size, limit):
    names = {
        "observation": "observations",
        "action": "actions",
        "reward": "rewards",
        "terminated": "terminals",
        "truncated": "timeouts",
    }
    rows, path = columns(), tmp_path / "set.hdf5"
    if limit:
        del rows["truncated"]
    with h5py.File(path, "w") as file:
        for name, column in rows.items():
            file[names[name]] = column
        file["infos/qpos"] = np.zeros((300, 6))
    options = {"max_episode_steps": limit}
    opened = slices_of_d4rl(path, **options)
    assert_same(opened, size, *load_d4rl(path, **options))
    with pytest.raises(FileNotFoundError, match="there is no file"):
        slices_of_d4rl(tmp_path / "other.hdf5")


@pytest.mark.parametrize("size", [1, 250, 10_000])
def test_minari(tmp_path, monkeypatch, size):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data, _ = load_local_dataset(
        "hopper", "random", num_transitions=500, cache_dir=tmp_path, progress=False
    )
    export_minari(data, "mine/random-v0", env_id="Hopper-v5", author="me")
    data, manifest = load_minari("mine/random-v0", progress=False)
    opened = slices_of_minari("mine/random-v0", size=size)
    rows, notes = collected(opened)
    assert (rows == data).all()
    described = opened.describe(notes)
    described.pop("files")
    assert described.items() <= manifest.items()
    rest = [chunk for chunk, _ in opened.chunks(notes[:1])]
    assert (torch.cat([rows[: notes[0]["rows"]], *rest]) == data).all()
    with pytest.raises(ValueError, match="announces 500: it is damaged"):
        opened.describe([])


def test_what_cannot_be_read_in_slices_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.npz"
    np.savez(path, **columns())
    with pytest.raises(ValueError, match=r"slice by slice.*take data.storage=memory"):
        slices_of_file(path)
    with pytest.raises(FileNotFoundError):
        slices_of_file(tmp_path / "log.h5")
    rows = columns()
    rows["terminated"][:] = rows["truncated"][:] = False
    monkeypatch.setattr(slices, "MAX_TRAJECTORY", 100)
    with pytest.raises(ValueError, match=r"begins in row 0 has no end within 160 rows"):
        in_slices(opened_rows(rows), 40)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.create_group("more"), "'more' is no array with rows"),
        (lambda file: file.create_dataset("more", data=3), "'more' is no array with"),
        (lambda file: file.create_dataset("more", data=[1, 2]), "unequal length"),
        (
            lambda file: file.__setitem__("more", h5py.ExternalLink("a.h5", "b")),
            "'more' leads into another file",
        ),
        (
            lambda file: file.create_dataset("more", (300, 5000), "f4"),
            "a row of 'more' has 20,000 bytes; at most 16,384",
        ),
    ],
)
def test_deviating_hdf5_files_are_refused(tmp_path, change, message):
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name, column in columns().items():
            file[name] = column
        change(file)
    with pytest.raises(ValueError, match=message):
        slices_of_file(path)


def test_deviating_parquet_files_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.parquet"
    path.write_bytes(b"no Parquet")
    with pytest.raises(ValueError, match="is no Parquet file, or damaged"):
        slices_of_file(path)
    parquet.write_table(pyarrow.table({"reward": np.zeros(300)}), path)
    monkeypatch.setattr("torchrl_osr.data.file_slices.MAX_GROUP_BYTES", 2000)
    with pytest.raises(ValueError, match=r"300 rows and about 2,400 bytes"):
        slices_of_file(path)
