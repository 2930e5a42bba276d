"""What a configuration names is what is loaded."""

from __future__ import annotations

import os

import numpy as np
import pytest
from recorded_logs import columns_of, save, save_d4rl

from torchrl_osr.lab.data import (
    RECORDED,
    export_minari,
    is_memory_mapped,
    load_dataset,
    load_file,
    load_local_dataset,
    normalized_score,
    write_memmap,
)
from torchrl_osr.lab.data.read import recording

MIXTURE = {"random_share": 0.0, "num_transitions": 500, "seed": 0}


pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture
def hopper():
    return load_local_dataset("hopper", "medium", num_transitions=500)


def test_qualities_are_rolled_out(hopper):
    data, manifest = load_dataset("hopper", "medium", env_id="Hopper-v5", **MIXTURE)
    assert (data == hopper[0]).all()
    assert manifest == hopper[1]


def write_recording(quality, folder, data):
    """Write data as a source of that kind; return its path."""
    if quality == "minari":
        export_minari(data, "mine/hopper-v0")
        return "mine/hopper-v0"
    if quality == "d4rl":
        return str(save_d4rl(folder / "hopper.hdf5", columns_of(data)))
    return str(save(folder / "hopper.npz", columns_of(data)))


@pytest.mark.parametrize("quality", RECORDED)
def test_recorded_data_are_read(hopper, quality, tmp_path):
    path = write_recording(quality, tmp_path, hopper[0])
    data, manifest = load_dataset(
        "hopper", quality, path=path, env_id="Hopper-v5", **MIXTURE
    )
    assert (data == hopper[0]).all()
    assert manifest["quality"] == quality
    score = normalized_score("hopper", manifest["return"]["mean"])
    assert manifest["normalized_score"] == score
    _, other = load_dataset("another", quality, path=path)
    assert other["normalized_score"] is None
    assert other["return"] == manifest["return"]
    with pytest.raises(ValueError, match=r"11 observation and 3 .*Walker2d-v5 has 17"):
        load_dataset("walker2d", quality, path=path, env_id="Walker2d-v5")


def test_a_set_without_a_complete_episode_has_no_score(tmp_path):
    data, _ = load_local_dataset("hopper", "expert", num_transitions=100)
    columns = columns_of(data) | {"truncated": np.zeros(100)}
    del columns["next_observation"]
    save(tmp_path / "part.npz", columns)
    _, manifest = load_dataset("hopper", "file", path=str(tmp_path / "part.npz"))
    assert manifest["normalized_score"] is None
    assert manifest["dropped_rows"] == 1
    assert load_file(tmp_path / "part.npz")[1]["return"] is None


def test_settings_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match=r"data=minari needs data\.path="):
        load_dataset("hopper", "minari")
    with pytest.raises(ValueError, match=r"data\.path=x has no use with data=medium"):
        load_dataset("hopper", "medium", path="x", **MIXTURE)
    with pytest.raises(ValueError, match=r"random_share=0\.5 .*it must be 0"):
        load_dataset("hopper", "file", path="x.npz", random_share=0.5)
    with pytest.raises(ValueError, match="unknown quality 'simple'"):
        load_dataset("hopper", "simple", **MIXTURE)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_rolled_out_data_on_disk_are_those_in_memory(share):
    recipe = MIXTURE | {"random_share": share}
    data, manifest = load_dataset("hopper", "medium", **recipe)
    stored, described = load_dataset("hopper", "medium", **recipe, on_disk=True)
    assert is_memory_mapped(stored)
    assert (stored == data).all()
    assert described["normalized_score"] == manifest["normalized_score"]


@pytest.mark.parametrize("quality", RECORDED)
def test_recorded_data_on_disk_are_those_in_memory(
    hopper, quality, tmp_path, monkeypatch
):
    monkeypatch.setattr(recording, "CHUNK_ROWS", 130)
    path = write_recording(quality, tmp_path, hopper[0])
    options = {"env_id": "Hopper-v5", "path": path}
    data, manifest = load_dataset("hopper", quality, **options)
    stored, described = load_dataset("hopper", quality, **options, on_disk=True)
    assert is_memory_mapped(stored)
    assert (stored == data).all()
    assert manifest.items() <= described.items()
    with pytest.raises(ValueError, match="has 11 observation and 3 action entries"):
        load_dataset("walker2d", quality, path=path, env_id="Walker2d-v5", on_disk=True)


def test_a_source_that_has_changed_is_converted_anew(hopper, cache, tmp_path):
    path = tmp_path / "hopper.hdf5"
    save_d4rl(path, columns_of(hopper[0]))
    options = {"path": str(path), "on_disk": True}
    for _ in range(2):
        stored, _ = load_dataset("hopper", "d4rl", **options)
        assert len(stored) == 500
        assert len(list((cache / "recorded").glob("d4rl-*/"))) == 1
    path.unlink()
    save_d4rl(path, columns_of(hopper[0][:400]))
    os.utime(path, ns=(0, 0))  # clocks may be coarse
    stored, _ = load_dataset("hopper", "d4rl", **options)
    assert len(stored) == 400


def test_a_set_that_was_written_by_hand(hopper, tmp_path):
    write_memmap([hopper[0]], tmp_path / "mine", progress=False)
    for on_disk in (False, True):
        data, manifest = load_dataset(
            "hopper", "file", path=str(tmp_path / "mine"), on_disk=on_disk
        )
        assert is_memory_mapped(data) == on_disk
        assert (data == hopper[0]).all()
        assert manifest["normalized_score"] is None
