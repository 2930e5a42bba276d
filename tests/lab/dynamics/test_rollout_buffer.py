"""Batches of real and imagined rows, and how they go on after a break."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_osr.lab.dynamics import Imagined, ImaginedReplayBuffer


def policy_of(weight: float = 0.0) -> nn.Linear:
    policy = nn.Linear(1, 1, bias=False)
    nn.init.constant_(policy.weight, weight)
    return policy


def rows_of(policy: nn.Linear) -> Imagined:
    """Nine rows that say which policy has imagined them, with noise below 1."""
    state = policy.weight.detach() + torch.rand(9, 1)
    following = {
        "reward": torch.ones(9, 1),
        "terminated": torch.arange(9).unsqueeze(-1) == 0,
    }
    return Imagined(TensorDict({"state": state, "next": following}, [9]), 3)


def make_buffer(policy: nn.Linear, *, seed: int = 0, **options) -> ImaginedReplayBuffer:
    real = ReplayBuffer(storage=LazyTensorStorage(50))
    following = {
        "reward": torch.zeros(50, 1),
        "terminated": torch.zeros(50, 1, dtype=torch.bool),
    }
    real.extend(TensorDict({"state": -torch.ones(50, 1), "next": following}, [50]))
    options = {"real_ratio": 0.25, "batch_size": 40} | options
    buffer = ImaginedReplayBuffer(
        real, policy, rows_of, interval=3, generations=2, seed=seed, **options
    )
    buffer.set_rng(torch.Generator().manual_seed(5))
    return buffer


def origins(batch: TensorDict) -> set[int]:
    return set(batch["state"].floor().int().flatten().tolist())


def test_batches_have_the_share_of_real_rows_and_the_newest_generations() -> None:
    policy, found = policy_of(), []
    buffer = make_buffer(policy)
    for number in range(12):
        nn.init.constant_(policy.weight, float(number))
        batch = buffer.sample()
        assert len(batch) == 40
        assert int((batch["state"] == -1).sum()) == 10
        found.append(origins(batch) - {-1})
    # Imagined before batches 0, 3, 6, 9; the last two are kept.
    assert found == [{0}] * 3 + [{0, 3}] * 3 + [{3, 6}] * 3 + [{6, 9}] * 3
    assert buffer.metrics() == {
        "imagined_refused": 0.25,
        "imagined_ended": pytest.approx(1 / 9),
        "imagined_reward": 1.0,
    }


def test_batches_are_transformed_as_a_whole() -> None:
    seen = []

    def note(batch):
        seen.append(len(batch))
        return batch.set("noted", torch.ones(len(batch)))

    batch = make_buffer(policy_of(), transform=note).sample()
    assert seen == [40]
    assert batch["noted"].all()


@pytest.mark.parametrize("stop", [1, 3, 4, 8, 9])
def test_a_continued_buffer_draws_the_same_batches(stop) -> None:
    """Whether or not a generation is due at the break."""
    policy = policy_of()
    whole = make_buffer(policy)
    for number in range(stop):
        nn.init.constant_(policy.weight, float(number))
        whole.sample()
    state = {"buffer": whole.state_dict(), "draws": whole._rng.get_state()}
    state = torch.load(as_file(state), weights_only=True)
    resumed = make_buffer(policy)
    torch.rand(7)  # whatever else has happened
    before = torch.get_rng_state()
    resumed.load_state_dict(state["buffer"])
    assert torch.equal(torch.get_rng_state(), before)
    resumed._rng.set_state(state["draws"])
    for number in range(stop, stop + 7):
        nn.init.constant_(policy.weight, float(number))
        torch.rand(number)
        assert (whole.sample() == resumed.sample()).all()


def as_file(state):
    import io

    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return file


def test_training_draws_the_same_numbers_with_and_without_a_generation() -> None:
    buffer = make_buffer(policy_of())
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    buffer.sample()
    assert torch.equal(torch.rand(2), expected)


@pytest.mark.parametrize(("ratio", "rows"), [(0.01, 0), (0.99, 40), (0.0, 0)])
def test_a_batch_of_one_kind_is_refused(ratio, rows) -> None:
    with pytest.raises(ValueError, match=f"of 40 rows are {rows}; expected real"):
        make_buffer(policy_of(), real_ratio=ratio)


def test_a_generation_without_rows_is_an_error() -> None:
    buffer = make_buffer(policy_of())
    buffer.rows_of = lambda policy: Imagined(rows_of(policy).rows[:0], 9)
    with pytest.raises(ValueError, match="no imagined row was taken"):
        buffer.sample()


def test_a_generation_that_is_no_longer_drawn_from_is_freed() -> None:
    buffer, held = make_buffer(policy_of()), []
    gc.disable()
    try:
        for number in range(18):
            buffer.sample()
            if number % 3 == 0:
                held.append(weakref.ref(buffer.imagined))
    finally:
        gc.enable()
    assert [each() is not None for each in held] == [False] * 5 + [True]
