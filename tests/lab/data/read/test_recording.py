"""Reading in parts gives the rows of reading at once, whatever the parts are."""

from __future__ import annotations

from functools import partial
from unittest import mock

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_settings import tried
from recorded_logs import make_columns, save, save_d4rl

from torchrl_osr.lab.data import (
    is_memory_mapped,
    load_dataset,
    load_file,
    transitions_from_rows,
)
from torchrl_osr.lab.data.read import recording

pytestmark = pytest.mark.usefixtures("cache")


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


def assert_same_in_parts(load, rows):
    """Require the same rows and manifest, read at once and in parts."""
    data, manifest = load()
    with mock.patch.object(recording, "CHUNK_ROWS", rows):
        stored, described = load(on_disk=True, progress=False)
    assert is_memory_mapped(stored)
    assert (stored == data).all()
    assert manifest.items() <= described.items()


@tried(60)
@given(columns=recordings(), rows=st.integers(1, 40))
def test_any_recording_in_parts_of_any_size(tmp_path_factory, columns, rows):
    path = tmp_path_factory.mktemp("log") / "log.npz"
    np.savez(path, **columns)
    try:
        transitions_from_rows(columns)
    except ValueError:
        with (
            mock.patch.object(recording, "CHUNK_ROWS", rows),
            pytest.raises(ValueError, match="holds nan|comes back|true next state"),
        ):
            load_file(path, on_disk=True, progress=False)
        return
    assert_same_in_parts(partial(load_file, path), rows)


def test_errors_say_in_which_rows_they_are(tmp_path, monkeypatch):
    columns = make_columns()
    columns["reward"][250] = np.nan
    save(tmp_path / "log.h5", columns)
    monkeypatch.setattr(recording, "CHUNK_ROWS", 50)
    message = r"in the rows from 240 on: 'reward' holds nan in row 10 of 40"
    with pytest.raises(ValueError, match=message):
        load_file(tmp_path / "log.h5", on_disk=True)


@pytest.mark.parametrize("rows", [1, 50, 1000])
@pytest.mark.parametrize("with_next", [True, False])
@pytest.mark.parametrize("ending", ["h5", "parquet"])
def test_files(tmp_path, ending, with_next, rows):
    columns = make_columns(with_next=with_next)
    options = {"row_group_size": 70} if ending == "parquet" else {}
    path = save(tmp_path / f"log.{ending}", columns, **options)
    assert_same_in_parts(partial(load_file, path), rows)


def test_a_trajectory_without_an_end_is_refused(tmp_path, monkeypatch):
    columns = make_columns()
    columns["terminated"][:] = columns["truncated"][:] = False
    save(tmp_path / "log.h5", columns)
    monkeypatch.setattr(recording, "MAX_TRAJECTORY", 100)
    monkeypatch.setattr(recording, "CHUNK_ROWS", 40)
    with pytest.raises(ValueError, match=r"begins in row 0 has no end within 160 rows"):
        load_file(tmp_path / "log.h5", on_disk=True)


def external(file, folder):
    file["rewards"] = h5py.ExternalLink("other.hdf5", "reward")


def soft_to_external(file, folder):
    file["infos/elsewhere"] = h5py.ExternalLink("other.hdf5", "/")
    file["rewards"] = h5py.SoftLink("/infos/elsewhere/reward")


def soft_to_soft_to_external(file, folder):
    soft_to_external(file, folder)
    file["first"] = file.get("rewards", getlink=True)
    del file["rewards"]
    file["rewards"] = h5py.SoftLink("/first")


def raw(file, folder):
    where = [(str(folder / "secret"), 0, 2400)]
    file.create_dataset("rewards", (300,), "f8", external=where)


def virtual(file, folder):
    layout = h5py.VirtualLayout((300,), "f8")
    layout[:] = h5py.VirtualSource(folder / "other.hdf5", "reward", (300,))
    file.create_virtual_dataset("rewards", layout)


@pytest.mark.parametrize("quality", ["d4rl", "file"])
@pytest.mark.parametrize(
    "craft", [external, soft_to_external, soft_to_soft_to_external, raw, virtual]
)
def test_nothing_is_read_from_another_hdf5_file(tmp_path, craft, quality):
    (tmp_path / "secret").write_bytes(bytes(2400))
    columns, path = make_columns(), tmp_path / "log.hdf5"
    save(tmp_path / "other.hdf5", columns)
    del columns["reward"]
    save_d4rl(path, columns)
    with h5py.File(path, "a") as file:
        craft(file, tmp_path)
        assert file["rewards"].shape == (300,), "the crafted file works"
    with pytest.raises(ValueError, match="leads into another file"):
        load_dataset("hopper", quality, path=str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.create_group("reward"), "'reward' is no array with rows"),
        (lambda file: file.create_dataset("reward", data=3), "'reward' is no array wi"),
        (
            lambda file: file.create_dataset("reward", (10**10,), "i1", chunks=True),
            r"log\.h5 would unpack to [\d,]+ bytes; at most 4,294,967,296",
        ),
    ],
)
def test_deviating_hdf5_files_are_refused(tmp_path, change, message):
    path = tmp_path / "log.h5"
    save(path, make_columns())
    with h5py.File(path, "a") as file:
        del file["reward"]
        change(file)
    with pytest.raises(ValueError, match=message):
        load_file(path)


@pytest.mark.parametrize("on_disk", [False, True])
def test_columns_of_unequal_length_are_refused(tmp_path, monkeypatch, on_disk):
    columns, path = make_columns(), tmp_path / "log.h5"
    columns["action"] = columns["action"][:290]
    save(path, columns)
    monkeypatch.setattr(recording, "CHUNK_ROWS", 50)
    with pytest.raises(ValueError, match="'action' has shape"):
        load_file(path, on_disk=on_disk)
