"""Rows of a data set: held out, mixed, in order, several steps together."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_osr.lab.data.rows import (
    check_order,
    episode_of,
    mix_datasets,
    multi_step,
    next_action,
    split_held_out,
    take_multi_step,
)

LENGTHS = st.lists(st.integers(1, 6), min_size=1, max_size=6)


def episodes(lengths) -> TensorDict:
    """Episodes that terminate or are cut off in turns, with random rewards.

    States are numbered from 1 on, and actions after them.
    """
    rows, at = [], 0
    for episode, length in enumerate(lengths):
        state = torch.arange(at, at + length + 1.0).unsqueeze(-1) + 1
        done = torch.arange(length).unsqueeze(-1) == length - 1
        terminated = done & (episode % 2 == 0)
        after = {"observation": state[1:], "reward": torch.randn(length, 1)}
        after |= {"done": done, "terminated": terminated}
        after["truncated"] = done ^ terminated
        columns = {"observation": state[:-1], "action": 0.001 * state[:-1]}
        rows.append(TensorDict(columns | {"next": after}, [length]))
        at += length + 1
    return torch.cat(rows)


@given(rows=st.integers(1, 50), share=st.floats(0, 1), seed=st.integers(0, 1000))
def test_rows_are_drawn_without_replacement_in_exact_shares(rows, share, seed) -> None:
    sets, options = episodes([rows, 100]), {"random_share": share, "seed": seed}
    sets = sets.split([rows, 100])
    first, second = (mix_datasets(*sets, **options) for _ in range(2))
    assert (first == second).all()
    check_order(first)  # what was cut is marked as an end
    mixed = (first["observation"].squeeze(-1).long() - 1).tolist()
    assert len(mixed) == len(set(mixed)) == rows
    kept = mixed[: rows - round(share * rows)]
    assert [row for row in mixed if row < rows] == kept == [*range(len(kept))]


@pytest.mark.parametrize(("held_out", "expected"), [(7, 7), (0.2, 10)])
def test_split_keeps_every_row_once(held_out: int | float, expected: int) -> None:
    data = TensorDict({"row": torch.arange(50)}, [50])
    train, rest = split_held_out(data, held_out, seed=1)
    assert len(rest) == expected
    both = torch.cat([train["row"], rest["row"]])
    assert torch.equal(both.sort().values, torch.arange(50))


def test_rows_in_no_order_are_refused_by_number() -> None:
    data = episodes([4, 5])
    for wrong in (data[[0, 2, 3, 4, 5, 6, 7, 8]], data[[0, 2, 1, 3]]):
        with pytest.raises(ValueError, match="row 0 the first, end no episode"):
            episode_of(wrong)
    with pytest.raises(ValueError, match="1 of the 8 rows, row 7 the first"):
        next_action(data[:-1])
    check_order(data[4:])


@settings(max_examples=30)
@given(LENGTHS, st.integers(1, 8))
def test_it_is_what_the_steps_add_up_to(lengths, n_steps) -> None:
    data = episodes(lengths)
    data["next", "action"] = next_action(data)
    found = multi_step(data, n_steps=n_steps, gamma=0.9)
    ends = torch.tensor(lengths).cumsum(0).tolist()
    for row in range(len(data)):
        end = min(each for each in ends if each > row)
        steps = range(row, min(row + n_steps, end))
        rewards = [data["next", "reward"][step].item() for step in steps]
        total = sum(0.9**k * reward for k, reward in enumerate(rewards))
        last = data[steps[-1]]
        assert found["reward"][row].item() == pytest.approx(total, abs=1e-5)
        for key in ("observation", "done", "terminated"):
            assert torch.equal(found[key][row], last["next", key])
        assert found["steps"][row] == len(steps)
        ended = last["next", "done"]
        wanted = 0.0 if ended else data["action"][steps[-1] + 1].item()
        assert found["action"][row].item() == wanted


def test_a_batch_takes_them_and_keeps_its_single_steps() -> None:
    data = episodes([4])
    data["multi_step"] = multi_step(data, n_steps=2, gamma=0.9)
    batch = take_multi_step(data.clone())
    assert (batch["one_step"] == data["next"]).all()
    assert (batch["next"] == data["multi_step"].exclude("steps")).all()
    assert batch["steps_to_next_obs"].flatten().tolist() == [2, 2, 2, 1]
    assert "multi_step" not in batch
