from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.data import make_replay_buffer, write_memmap
from torchrl_osr.lab.data.rows import held_out_rows, split_held_out


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


def test_sampling_is_uniform_with_replacement() -> None:
    buffer = make_replay_buffer(numbered_rows(10), batch_size=1000, seed=0)
    counts = torch.bincount(draws(buffer, 10).long(), minlength=10)
    # Expected 1000 each with a standard deviation of 30.
    assert counts.min() > 850
    assert counts.max() < 1150


@pytest.fixture
def both(make_transitions, tmp_path):
    """The same rows in memory and memory-mapped."""
    data = make_transitions(200)
    return data, write_memmap([data], tmp_path / "set", progress=False)[0]


def test_the_same_seed_draws_the_same_rows_from_disk(both) -> None:
    buffers = [make_replay_buffer(each, batch_size=32, seed=3) for each in both]
    for _ in range(10):
        here, there = (buffer.sample() for buffer in buffers)
        assert (here == there).all()
    assert len(buffers[1]) == 200
    with pytest.raises(RuntimeError):
        buffers[1].extend(both[0])


@pytest.mark.parametrize("held_out", [1, 7, 0.2, 199])
def test_rows_on_disk_that_are_left_out(both, held_out) -> None:
    data, stored = both
    left_out = held_out_rows(200, held_out, seed=1).sort().values
    train, rest = split_held_out(data, held_out, seed=1)
    assert (stored[left_out] == rest).all()
    buffer = make_replay_buffer(stored, batch_size=32, seed=3, left_out=left_out)
    same = make_replay_buffer(train, batch_size=32, seed=3)
    assert len(buffer) == len(train)
    for _ in range(20):
        assert (buffer.sample() == same.sample()).all()
    with pytest.raises(ValueError, match="for memory-mapped data"):
        make_replay_buffer(data, batch_size=32, seed=3, left_out=left_out)
