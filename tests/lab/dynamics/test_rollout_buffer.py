"""Batches of real and synthetic rows, and their continuation after a break."""

from __future__ import annotations

import gc
import io
import weakref

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_osr.lab.dynamics import Rollout, RolloutReplayBuffer


def rollout_of(policy: nn.Linear) -> Rollout:
    """Nine rows that say whose they are, with noise below 1."""
    state = policy.weight.detach() + torch.rand(9, 1)
    following = {
        "reward": torch.ones(9, 1),
        "terminated": torch.arange(9).unsqueeze(-1) == 0,
    }
    return Rollout(TensorDict({"state": state, "next": following}, [9]), 3)


def make_buffer(**options) -> RolloutReplayBuffer:
    policy = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(policy.weight)
    real = ReplayBuffer(storage=LazyTensorStorage(50))
    following = {
        "reward": torch.zeros(50, 1),
        "terminated": torch.zeros(50, 1, dtype=torch.bool),
    }
    real.extend(TensorDict({"state": -torch.ones(50, 1), "next": following}, [50]))
    options = {"real_ratio": 0.25, "batch_size": 40} | options
    buffer = RolloutReplayBuffer(
        real, policy, rollout_of, interval=3, generations=2, seed=0, **options
    )
    buffer.set_rng(torch.Generator().manual_seed(5))
    return buffer


def test_batches_have_the_share_of_real_rows_and_the_newest_generations() -> None:
    found, sizes = [], []

    def note(batch: TensorDict) -> TensorDict:
        sizes.append(len(batch))
        return batch

    buffer = make_buffer(transform=note)
    before = torch.get_rng_state()
    for number in range(12):
        nn.init.constant_(buffer.policy.weight, float(number))
        state = buffer.sample()["state"]
        assert int((state == -1).sum()) == 10
        found.append({*state.floor().int().flatten().tolist()} - {-1})
    # Rolled out before batches 0, 3, 6, 9; the last two are kept.
    assert found == [{0}] * 3 + [{0, 3}] * 3 + [{3, 6}] * 3 + [{6, 9}] * 3
    assert sizes == [40] * 12
    assert torch.equal(torch.get_rng_state(), before)
    assert buffer.metrics() == {
        "rollout_rejected": 0.25,
        "rollout_terminated": pytest.approx(1 / 9),
        "rollout_reward": 1.0,
    }


@pytest.mark.parametrize("stop", [1, 3, 8])
def test_a_continued_buffer_draws_the_same_batches(stop) -> None:
    """Whether or not a generation is due at the break."""
    whole, resumed = make_buffer(), make_buffer()
    for number in range(stop):
        nn.init.constant_(whole.policy.weight, float(number))
        whole.sample()
    file = io.BytesIO()
    torch.save({"buffer": whole.state_dict(), "draws": whole._rng.get_state()}, file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    torch.rand(7)  # whatever else has happened
    before = torch.get_rng_state()
    resumed.load_state_dict(state["buffer"])
    assert torch.equal(torch.get_rng_state(), before)
    resumed._rng.set_state(state["draws"])
    for number in range(stop, stop + 7):
        for each in (whole, resumed):
            nn.init.constant_(each.policy.weight, float(number))
        torch.rand(number)
        assert (whole.sample() == resumed.sample()).all()


@pytest.mark.parametrize(("ratio", "rows"), [(0.01, 0), (0.99, 40)])
def test_a_batch_of_one_kind_is_refused(ratio, rows) -> None:
    with pytest.raises(ValueError, match=f"of 40 rows are {rows}; expected real"):
        make_buffer(real_ratio=ratio)


def test_a_rollout_without_rows_is_an_error() -> None:
    buffer = make_buffer()
    buffer.rollout = lambda policy: Rollout(rollout_of(policy).rows[:0], 9)
    with pytest.raises(ValueError, match="rejects all rows"):
        buffer.sample()


def test_old_generations_are_freed() -> None:
    buffer, held = make_buffer(), []
    gc.disable()
    try:
        for number in range(18):
            buffer.sample()
            if number % 3 == 0:
                held.append(weakref.ref(buffer.synthetic))
    finally:
        gc.enable()
    assert [each() is not None for each in held] == [False] * 5 + [True]
