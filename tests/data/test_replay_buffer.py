from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.data import (
    make_replay_buffer,
    observation_statistics,
    split_held_out,
)


def numbered_rows(rows: int) -> TensorDict:
    observation = torch.arange(rows, dtype=torch.float32)[:, None].repeat(1, 2)
    following = TensorDict({"observation": observation + 1}, [rows])
    return TensorDict({"observation": observation, "next": following}, [rows])


def draws(buffer, batches: int) -> torch.Tensor:
    return torch.cat([buffer.sample()["observation"][:, 0] for _ in range(batches)])


def test_batches_depend_on_the_seed_alone() -> None:
    data = numbered_rows(50)
    first = draws(make_replay_buffer(data, batch_size=16, seed=3), 4)
    torch.manual_seed(123)
    second = draws(make_replay_buffer(data, batch_size=16, seed=3), 4)
    other = draws(make_replay_buffer(data, batch_size=16, seed=4), 4)
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_sampling_leaves_the_global_generator_alone() -> None:
    buffer = make_replay_buffer(numbered_rows(50), batch_size=16, seed=0)
    before = torch.get_rng_state()
    buffer.sample()
    assert torch.equal(torch.get_rng_state(), before)


def test_sampling_is_uniform_with_replacement() -> None:
    buffer = make_replay_buffer(numbered_rows(10), batch_size=1000, seed=0)
    counts = torch.bincount(draws(buffer, 10).long(), minlength=10)
    # Expected 1000 each with a standard deviation of 30.
    assert counts.min() > 850
    assert counts.max() < 1150


def test_rows_stay_together_and_transforms_are_applied() -> None:
    from torchrl.envs.transforms import ObservationNorm

    halve = ObservationNorm(loc=0.0, scale=0.5, in_keys=["observation"])
    buffer = make_replay_buffer(
        numbered_rows(50), batch_size=16, seed=0, transform=halve
    )
    batch = buffer.sample()
    assert torch.equal(2 * batch["observation"] + 1, batch["next", "observation"])


def test_buffer_does_not_share_memory_with_the_data() -> None:
    data = numbered_rows(50)
    buffer = make_replay_buffer(data, batch_size=16, seed=0)
    data["observation"].fill_(-1)
    assert (buffer.sample()["observation"] >= 0).all()


def test_empty_or_unflat_data_are_refused() -> None:
    with pytest.raises(ValueError, match=r"batch size \[0\]; expected a flat \[N\]"):
        make_replay_buffer(TensorDict({}, [0]), batch_size=1, seed=0)
    with pytest.raises(ValueError, match=r"batch size \[2, 3\]"):
        make_replay_buffer(TensorDict({}, [2, 3]), batch_size=1, seed=0)


def test_statistics_by_hand() -> None:
    rows = torch.tensor([[1.0, 7.0, 0.0], [3.0, 7.0, 1e-5]])
    loc, scale = observation_statistics(TensorDict({"observation": rows}, [2]))
    torch.testing.assert_close(loc, torch.tensor([2.0, 7.0, 5e-6]))
    torch.testing.assert_close(scale, torch.tensor([1.0, 1e-3, 1e-3]))


def test_statistics_survive_a_large_offset() -> None:
    # Sums in float32 would be off in the second digit.
    rows = 1e4 + torch.tensor([-1.0, 1.0]).repeat(500_000)[:, None]
    data = TensorDict({"observation": rows}, [len(rows)])
    loc, scale = observation_statistics(data)
    torch.testing.assert_close(loc, torch.tensor([1e4]))
    torch.testing.assert_close(scale, torch.tensor([1.0]))
    assert loc.dtype == torch.float32


@pytest.mark.parametrize(("held_out", "expected"), [(7, 7), (0.2, 10)])
def test_split_keeps_every_row_once(held_out: int | float, expected: int) -> None:
    data = numbered_rows(50)
    train, rest = split_held_out(data, held_out, seed=1)
    again, _ = split_held_out(data, held_out, seed=1)
    other, _ = split_held_out(data, held_out, seed=2)
    assert len(rest) == expected
    both = torch.cat([train["observation"], rest["observation"]])[:, 0]
    assert torch.equal(both.sort().values, torch.arange(50.0))
    assert torch.equal(train["observation"], again["observation"])
    assert not torch.equal(train["observation"], other["observation"])


@pytest.mark.parametrize("held_out", [0, 50, 0.0, 1.0, -1])
def test_split_with_an_empty_side_is_refused(held_out: int | float) -> None:
    with pytest.raises(ValueError, match="at least one row on each side"):
        split_held_out(numbered_rows(50), held_out, seed=0)
