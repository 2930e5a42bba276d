"""Training data, prepared and split."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch
from composed import SMALL, configured
from recorded_logs import make_columns

from torchrl_osr.lab.run.data import TrainingData, load_data, load_training_data


def load(*overrides: str, in_keys=()) -> TrainingData:
    config = configured(*SMALL, "optim.n_steps=5", *overrides)
    return load_training_data(config, in_keys=in_keys)


def test_preparing_leaves_the_global_generator_alone():
    state = torch.get_rng_state()
    here, there = load(), load()
    assert torch.equal(state, torch.get_rng_state())
    assert (here.held_out == there.held_out).all()
    for _ in range(5):
        batch, other = (each.buffer.sample() for each in (here, there))
        assert (batch == other).all()


def test_the_next_action_is_there_for_losses_that_read_it():
    key = ("next", "action")
    config = configured(*SMALL)
    whole, _ = load_data(config.env, config.data, progress=False)
    data = load("data.standardize=false", "data.held_out=0.5", in_keys=[key])
    assert key not in load().buffer.sample().keys(True)
    load("data=medium", "data.random_share=0.5", in_keys=[key])
    for row in data.buffer.sample():
        for after in (row["next"], row["multi_step"]):
            if not after["done"]:
                at = (whole["observation"] == after["observation"]).all(-1)
                assert torch.equal(whole["action"][at].squeeze(0), after["action"])


def test_rewards_are_scaled_then_shifted():
    maze = ["env=pointmaze-umaze", "data=diverse"]
    bare = load(*maze)
    options = ["optim.gamma=0.5", "data.reward_scale=10.0", "data.reward_shift=-5.0"]
    data = load(*maze, *options)
    before, after = (each.buffer[:] for each in (bare, data))
    reached = before["next", "reward"] == 1
    assert (after["next", "reward"][reached] == 5).all()
    assert (after["next", "reward"][~reached] == -5).all()
    assert (bare.largest_reward, data.largest_reward) == (1, 5)
    assert data.data_mean == bare.data_mean, "the data's own score stays"
    never = before["multi_step", "reward"] == 0
    discounts = 2 * (1 - 0.5 ** after["multi_step", "steps"][never])
    torch.testing.assert_close(after["multi_step", "reward"][never], -5 * discounts)
    for name in ("next", "multi_step"):
        after[name, "reward"] = before[name, "reward"]
    assert (after == before).all(), "nothing else is touched"


def test_a_log_of_ends_alone_teaches_no_recovery(tmp_path):
    columns = make_columns(60)
    columns |= {"terminated": np.ones(60), "action": columns["action"][:, :1]}
    np.savez(log := tmp_path / "log.npz", **columns)
    given = "env.id=Pendulum-v1", "data=file", f"data.path={log}"
    small = [each for each in SMALL if not each.startswith("data=")]
    config = configured(*small, *given)
    with pytest.raises(ValueError, match="every row ends an episode.*loss=bc"):
        load_training_data(config, in_keys=["observation", ("next", "done")])
    load_training_data(config, in_keys=["observation"])


def test_a_d4rl_file_has_the_bounds_of_its_run(tmp_path):
    rows = np.linspace(-1, 1, 10, dtype=np.float32)[:, None]
    with h5py.File(tmp_path / "log.hdf5", "w") as file:
        file.update(observations=rows, actions=rows, rewards=rows[:, 0])
        file.update(terminals=rows[:, 0] > 9, timeouts=rows[:, 0] == 1)
    config = configured("data=d4rl", f"data.path={tmp_path}/log.hdf5")
    config.env.id, config.env.action_low, config.env.action_high = None, [-2.0], [2.0]
    data, _ = load_data(config.env, config.data, progress=False)
    assert torch.equal(data["action"], torch.from_numpy(rows[:9] / 2))
