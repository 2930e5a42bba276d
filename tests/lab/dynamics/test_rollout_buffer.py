"""Batches of real and synthetic rows, and their continuation after a break."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage

from torchrl_osr.lab.dynamics import DynamicsOptions, ModelData, RolloutReplayBuffer
from torchrl_osr.modules import deterministic_actor

TINY = DynamicsOptions(
    num_networks=3, num_elites=2, num_cells=[8], rollout_starts=20, rollout_interval=3,
    generations=2, real_ratio=0.25,
)  # fmt: skip


class Numbered(RolloutReplayBuffer):
    """Nine rows that say whose they are, with noise below 1."""

    def roll_out(self, copied: nn.Linear) -> TensorDict:
        state, ended = copied.weight.detach() + torch.rand(9, 1), torch.arange(9) == 0
        return rows_of(state, torch.ones(9, 1), ended.unsqueeze(-1))


def rows_of(state, reward, terminated) -> TensorDict:
    following = {"reward": reward, "terminated": terminated}
    return TensorDict({"state": state, "next": following}, [len(state)])


def test_batches_have_the_share_of_real_rows_and_the_newest_generations(data) -> None:
    zeros, storage = torch.zeros(50, 1), LazyTensorStorage(50)
    storage.set(range(50), rows_of(zeros - 1, zeros, zeros.bool()))
    buffer = Numbered(
        replace(TINY, unknown="take"), replace(data, storage=storage),
        TINY.ensemble(11, 3), nn.Linear(1, 1, bias=False), batch_size=40, n_steps=1,
        transform=lambda batch: batch,
    )  # fmt: skip
    buffer.set_rng(torch.Generator().manual_seed(5))
    found, before = [], torch.get_rng_state()
    for number in range(12):
        nn.init.constant_(buffer.policy.weight, float(number))
        state = buffer.sample()["state"]
        assert (len(state), int((state == -1).sum())) == (40, 10)
        found.append({*state.floor().int().flatten().tolist()} - {-1})
    # Rolled out before batches 0, 3, 6, 9; the last two are kept.
    assert found == [{0}] * 3 + [{0, 3}] * 3 + [{3, 6}] * 3 + [{6, 9}] * 3
    assert torch.equal(torch.get_rng_state(), before)


def buffer_of(data: ModelData, options: DynamicsOptions, **batches):
    """Return a buffer of rollouts, a batch, the untrained model and the actor."""
    torch.manual_seed(0)
    model, actor = options.ensemble(11, 3), deterministic_actor(11, 3, num_cells=[8])
    batches = {"batch_size": 8, "n_steps": 1, "transform": lambda each: each} | batches
    buffer = RolloutReplayBuffer(options, data, model, actor, **batches)
    return buffer, buffer.sample(), model, actor


@pytest.mark.parametrize("steps", [0, 3])
def test_rollouts_start_in_states_of_the_data_or_beside_them(data, steps) -> None:
    buffer, *_ = buffer_of(data, replace(TINY, perturbed_start_steps=steps))
    starts = buffer.synthetic["observation"][:10]
    known = data.storage.get(torch.arange(540))["observation"]
    there = (starts.unsqueeze(1) == known).all(-1).any(1)
    assert not there.any() if steps else there.all()


@pytest.mark.parametrize(("noise", "n_steps"), [(0.0, 1), (0.3, 1), (0.0, 3)])
def test_synthetic_rows_are_marked_and_may_have_noise(data, noise, n_steps) -> None:
    options = replace(TINY, action_noise=noise)
    if n_steps > 1:
        rows = data.storage.get(range(540))
        steps = torch.full((540, 1), n_steps)
        rows["multi_step"] = rows["next"].clone().set("steps", steps)
        storage = LazyTensorStorage(540)
        storage.set(range(540), rows)
        data = replace(data, storage=storage)
    _, batch, _, actor = buffer_of(data, options, n_steps=n_steps)
    assert batch["is_synthetic"].flatten().tolist() == [False] * 2 + [True] * 6
    rows = batch[2:]
    apart = (rows["action"] - actor(rows.select("observation"))["action"]).abs()
    assert (0.01 < apart.max() < 2) if noise else (apart.max() < 1e-6)
    if n_steps > 1:
        steps = batch["steps_to_next_obs"].flatten().tolist()
        assert steps == [n_steps] * 2 + [1] * 6


@pytest.mark.parametrize("shift", [100.0, -100.0])
def test_the_task_ends_where_the_model_is_unsure(data, shift) -> None:
    data.held_out["next", "reward"] += shift
    options = replace(TINY, unknown="halt", known_share=0.5, rollout_starts=400)
    buffer, *_ = buffer_of(replace(data, env_id=None), options)
    first = buffer.synthetic[:400]["next"]
    ended = first["terminated"].squeeze(-1)
    assert 0.3 < ended.float().mean() < 0.7
    worst = min(data.held_out["next", "reward"].quantile(0.01).item(), 0)
    wanted = torch.full([int(ended.sum()), 1], worst / (1 - 0.99))
    torch.testing.assert_close(first["reward"][ended], wanted)


def test_penalty_and_ends_are_in_the_units_of_the_task(data) -> None:
    options = replace(TINY, unknown="take", rollout_steps=1)
    buffer, _, model, _ = buffer_of(data, options)
    free = buffer.synthetic
    lowered = buffer_of(data, replace(options, penalty=1.5))[0].synthetic
    assert torch.equal(free["next", "observation"], lowered["next", "observation"])
    _, scale = model.predict(free["observation"], free["action"])
    scale[..., :-1] *= data.scale
    scale[..., -1] /= data.reward_scale
    wanted = 1.5 * data.reward_scale * scale.norm(dim=-1).max(0).values
    lost = (free["next", "reward"] - lowered["next", "reward"]).squeeze(-1)
    torch.testing.assert_close(lost, wanted)
    state = free["next", "observation"] * data.scale + data.loc
    fallen = (state[:, 0] <= 0.7) | (state[:, 1].abs() >= 0.2)
    assert torch.equal(free["next", "terminated"].squeeze(-1), fallen)
    assert fallen.any()
