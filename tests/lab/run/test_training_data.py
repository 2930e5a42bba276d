"""Training from disk and from memory: the same batches, the same losses."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch
from composed import SMALL, composed

from torchrl_osr.lab.cli import train
from torchrl_osr.lab.evaluation import DataDistance
from torchrl_osr.lab.run import run_folder
from torchrl_osr.lab.run.build import load_data
from torchrl_osr.lab.run.training_data import load_training_data

CPU = torch.device("cpu")
pytestmark = pytest.mark.usefixtures("own_cache")


def small(*overrides: str):
    steps = "trainer.steps=10", "trainer.eval_interval=10"
    return composed("train", *SMALL, *steps, *overrides)


@pytest.mark.parametrize(
    "more",
    [[], ["data.standardize=false"], ["data.reward_scale=3.0", "data.reward_shift=-1"]],
)
def test_the_same_seed_gives_the_same_batches(more):
    here, there = (
        load_training_data(small(f"data.storage={storage}", *more), CPU)
        for storage in ("memory", "disk")
    )
    torch.testing.assert_close(there.held_out, here.held_out, rtol=0, atol=1e-6)
    assert there.mean == here.mean
    assert there.largest_reward == pytest.approx(here.largest_reward)
    for _ in range(20):
        batch, other = (each.buffer.sample() for each in (here, there))
        torch.testing.assert_close(other, batch, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("held_out", [0.1, 0.5])
def test_the_next_action_is_there_for_losses_that_read_it(held_out):
    key = ("next", "action")
    whole, _ = load_data(small(), progress=False)
    overrides = ["data.standardize=false", f"data.held_out={held_out}"]
    here, there = (
        load_training_data(small(f"data.storage={each}", *overrides), CPU, [key])
        for each in ("memory", "disk")
    )
    assert key not in load_training_data(small(), CPU).buffer.sample().keys(True)
    for _ in range(20):
        batch, other = (each.buffer.sample() for each in (here, there))
        torch.testing.assert_close(other, batch, rtol=1e-6, atol=1e-6)
        for row in batch:
            for after in (row["next"], row["multi_step"]):
                if not after["done"]:
                    at = (whole["observation"] == after["observation"]).all(-1)
                    assert torch.equal(whole["action"][at].squeeze(0), after["action"])


def test_without_an_order_the_next_action_is_refused():
    cfg = small("data=medium", "data.random_share=0.5", "loss=rebrac")
    with pytest.raises(
        ValueError, match="ReBRACLoss reads .*random_share=0.5 does not"
    ):
        load_training_data(cfg, CPU, [("next", "action")])


def test_rewards_are_scaled_then_shifted():
    maze = ["env=pointmaze-umaze", "data=diverse"]
    bare = load_training_data(small(*maze), CPU)
    options = ["optim.gamma=0.5", "data.reward_scale=10.0", "data.reward_shift=-5.0"]
    data = load_training_data(small(*maze, *options), CPU)
    before, after = (each.buffer[:] for each in (bare, data))
    reached = before["next", "reward"] == 1
    assert (after["next", "reward"][reached] == 5).all()
    assert (after["next", "reward"][~reached] == -5).all()
    assert (bare.largest_reward, data.largest_reward) == (1, 5)
    assert data.mean == bare.mean, "the data's own score stays"
    never = before["multi_step", "reward"] == 0
    discounts = 2 * (1 - 0.5 ** after["multi_step", "steps"][never])
    torch.testing.assert_close(after["multi_step", "reward"][never], -5 * discounts)
    for name in ("next", "multi_step"):
        after[name, "reward"] = before[name, "reward"]
    assert (after == before).all(), "nothing else is touched"


def losses(folder: Path) -> dict[str, list[float]]:
    values = {}
    for path in sorted((folder / "csv").rglob("*.csv")):
        with path.open() as file:
            values[path.name] = [float(row[-1]) for row in csv.reader(file)]
    return values


def test_the_same_seed_gives_the_same_training(tmp_path):
    results = []
    for storage in ("memory", "disk"):
        cfg, folder = small(f"data.storage={storage}"), tmp_path / storage
        folder.mkdir()
        with run_folder.status(folder):
            train.run(cfg, folder)
        results.append(losses(folder))
    here, there = results
    assert len(here) > 5
    assert here.keys() == there.keys()
    for name, values in here.items():
        assert there[name] == pytest.approx(values, rel=1e-5, abs=1e-6), name


def test_distances_are_those_of_memory():
    data, _ = load_data(small(), progress=False)
    stored, _ = load_data(small("data.storage=disk"), progress=False)
    here, there = (DataDistance(each, max_reference=300) for each in (data, stored))
    assert there.threshold == pytest.approx(here.threshold, rel=1e-5)
    states = torch.randn(20, 11)
    torch.testing.assert_close(there(states), here(states), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data.storage=tape"], "data.storage must be one of"),
    ],
)
def test_what_cannot_be_had_is_refused_before_the_data(overrides, message, monkeypatch):
    monkeypatch.setattr("torchrl_osr.lab.data.load_dataset", None)
    with pytest.raises(ValueError, match=message):
        load_training_data(small(*overrides), CPU)
