"""What a configuration says of the data is what is trained on."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from torchrl_osr.data import load_local_dataset
from torchrl_osr.experiment.build import load_data


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_OSR_CACHE", str(tmp_path))


def loaded(**data):
    """Of a configuration as an older run has it, without the newer keys."""
    given = {"level": "diverse", "num_transitions": 500, "seed": 0} | data
    env = {"name": "pointmaze-umaze", "id": "PointMaze_UMaze-v3"}
    return load_data(OmegaConf.create({"env": env, "data": given}))


def test_rewards_are_scaled_then_shifted():
    data, manifest = load_local_dataset(
        "pointmaze-umaze", "diverse", num_transitions=500
    )
    shifted, same = loaded(reward_scale=10.0, reward_shift=-5.0)
    assert same == manifest, "the data's own score stays"
    assert sorted(data["next", "reward"].unique().tolist()) == [0, 1]
    reached = data["next", "reward"] == 1
    assert (shifted["next", "reward"][reached] == 5).all()
    assert (shifted["next", "reward"][~reached] == -5).all()
    shifted["next", "reward"] = data["next", "reward"]
    assert (shifted == data).all(), "nothing else is touched"


def test_older_configurations_have_the_tasks_rewards():
    data, _ = load_local_dataset("pointmaze-umaze", "diverse", num_transitions=500)
    assert (loaded()[0] == data).all()
    assert (loaded(reward_scale=1.0, reward_shift=0.0)[0] == data).all()
