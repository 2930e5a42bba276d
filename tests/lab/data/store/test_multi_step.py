"""Transitions of several steps against a loop over the steps."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from numbered_episodes import LENGTHS, episodes
from property_settings import tried

from torchrl_osr.lab.data.store.multi_step import multi_step, take_multi_step


@tried(30)
@given(LENGTHS, st.integers(1, 8))
def test_it_is_what_the_steps_add_up_to(lengths, n_steps) -> None:
    data = episodes(lengths)
    found = multi_step(
        data,
        n_steps=n_steps,
        gamma=0.9,
        reward_scale=2.0,
        reward_shift=-1.0,
        with_next_action=True,
    )
    ends = torch.tensor(lengths).cumsum(0).tolist()
    for row in range(len(data)):
        end = min(each for each in ends if each > row)
        steps = range(row, min(row + n_steps, end))
        rewards = [2.0 * data["next", "reward"][step].item() - 1.0 for step in steps]
        total = sum(0.9**k * reward for k, reward in enumerate(rewards))
        last = data[steps[-1]]
        torch.testing.assert_close(
            found["reward"][row].item(), total, rtol=0, atol=1e-5
        )
        for key in ("observation", "done", "terminated"):
            assert torch.equal(found[key][row], last["next", key])
        assert found["steps"][row] == len(steps)
        ended = last["next", "done"]
        wanted = 0.0 if ended else data["action"][steps[-1] + 1].item()
        assert found["action"][row].item() == wanted


@tried(20)
@given(LENGTHS, st.randoms(use_true_random=False))
def test_some_rows_are_those_of_all(lengths, random) -> None:
    data = episodes(lengths)
    rows = torch.tensor([random.randrange(len(data)) for _ in range(4)])
    options = {"n_steps": 3, "gamma": 0.9}
    assert (
        multi_step(data, rows, **options) == multi_step(data, **options)[rows]
    ).all()


def test_rows_in_no_order_are_single_steps() -> None:
    data = episodes([4, 4])[[0, 2, 4, 6, 7]]
    found = multi_step(data, n_steps=3, gamma=0.9)
    assert found["steps"].flatten().tolist() == [1, 1, 1, 2, 1]
    alone = found.exclude("steps")[:3]
    assert (alone == data["next"][:3]).all()


def test_a_batch_takes_them_and_keeps_its_single_steps() -> None:
    data = episodes([4])
    data["multi_step"] = multi_step(data, n_steps=2, gamma=0.9)
    batch = take_multi_step(data.clone())
    assert (batch["one_step"] == data["next"]).all()
    assert (batch["next"] == data["multi_step"].exclude("steps")).all()
    assert batch["steps_to_next_obs"].flatten().tolist() == [2, 2, 2, 1]
    assert "multi_step" not in batch
