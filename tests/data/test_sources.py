"""What a configuration names is what is loaded."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from torchrl_osr.data import (
    export_minari,
    load_dataset,
    load_file,
    load_local_dataset,
    normalized_score,
)

MIXTURE = {"random_share": 0.0, "num_transitions": 500, "seed": 0}


@pytest.fixture(autouse=True)
def _folders(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


@pytest.fixture
def hopper():
    return load_local_dataset("hopper", "medium", num_transitions=500)


def write(path, data):
    following = data["next"]
    if path.suffix == ".hdf5":
        with h5py.File(path, "w") as file:
            file["observations"] = data["observation"]
            file["actions"] = data["action"]
            file["next_observations"] = following["observation"]
            file["rewards"] = following["reward"][:, 0]
            file["terminals"] = following["terminated"][:, 0]
            file["timeouts"] = following["truncated"][:, 0]
        return
    np.savez(
        path,
        observation=data["observation"],
        action=data["action"],
        next_observation=following["observation"],
        reward=following["reward"],
        terminated=following["terminated"],
        truncated=following["truncated"],
    )


def test_levels_are_rolled_out(hopper):
    data, manifest = load_dataset("hopper", "medium", env_id="Hopper-v5", **MIXTURE)
    assert (data == hopper[0]).all()
    assert manifest == hopper[1]


@pytest.mark.parametrize("level", ["minari", "d4rl", "file"])
def test_recorded_data_are_read(hopper, level, tmp_path):
    path = {
        "minari": "mine/hopper-v0",
        "d4rl": str(tmp_path / "hopper.hdf5"),
        "file": str(tmp_path / "hopper.npz"),
    }[level]
    if level == "minari":
        export_minari(hopper[0], path)
    else:
        write(tmp_path / path, hopper[0])
    data, manifest = load_dataset(
        "hopper", level, path=path, env_id="Hopper-v5", **MIXTURE
    )
    assert (data == hopper[0]).all()
    assert manifest["level"] == level
    score = normalized_score("hopper", manifest["return"]["mean"])
    assert manifest["normalized_score"] == score
    _, other = load_dataset("another", level, path=path)
    assert other["normalized_score"] is None
    assert other["return"] == manifest["return"]
    with pytest.raises(ValueError, match=r"11 observation and 3 .*Walker2d-v5 has 17"):
        load_dataset("walker2d", level, path=path, env_id="Walker2d-v5")


def test_a_set_without_a_complete_episode_has_no_score(tmp_path):
    data, _ = load_local_dataset("hopper", "expert", num_transitions=100)
    columns = {"observation": data["observation"], "action": data["action"]}
    columns["reward"] = data["next", "reward"]
    columns |= {"terminated": np.zeros(100), "episode": np.zeros(100, int)}
    np.savez(tmp_path / "part.npz", **columns)
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
    with pytest.raises(ValueError, match="unknown level 'simple'"):
        load_dataset("hopper", "simple", **MIXTURE)
