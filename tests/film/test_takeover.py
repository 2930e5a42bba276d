"""Whoever takes over does so in the same state, and is counted rightly."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from torchrl_osr.envs import ExternalPush
from torchrl_osr.evaluation import Trajectory
from torchrl_osr.film import BEHAVIOR, Survival, play_takeovers, survival_table
from torchrl_osr.film.takeover import NEVER, hand_over, steps_alive


def trajectory(entries: int, *, terminated: bool) -> Trajectory:
    states = [np.zeros(1, np.float32)] * entries
    return Trajectory(states, [False] * entries, terminated)


def test_hand_over_is_row_by_row_and_asks_both_in_every_step():
    asked = []

    def policy(value):
        def act(observation):
            asked.append(value)
            return torch.full((len(observation), 1), float(value))

        return act

    both = hand_over(policy(1), policy(2), torch.tensor([0, 2, NEVER]))
    played = [both(torch.zeros(3, 1))[:, 0].tolist() for _ in range(3)]
    assert played == [[2, 1, 1], [2, 1, 1], [2, 2, 1]]
    assert asked == [1, 2] * 3


def test_all_are_in_the_same_state_until_the_push_is_over():
    push = partial(ExternalPush, force=50.0, duration=2, at="random", window=(3, 6))
    given = []

    def still(observation):
        return torch.zeros(len(observation), 3)

    def other(references):
        given.append([len(each) for each in references])
        return lambda observation: torch.ones(len(observation), 3)

    played, ends = play_takeovers(
        "Hopper-v5", still, {"other": other}, push, duration=2, latest=6, after=4,
        num_episodes=3, seed=5,
    )  # fmt: skip
    assert list(played) == [BEHAVIOR, "other"]
    assert given == [[13] * 3] * 2, "reset, 6 steps, 2 of the push and 4 later"
    for episode, end in enumerate(ends.tolist()):
        assert 5 <= end < 8
        first, second = (
            each.disturbed.trajectories[episode] for each in played.values()
        )
        clean = played[BEHAVIOR].clean.trajectories[episode]
        assert first.disturbed[end - 1 : end + 2] == [True, True, False]
        states, others = np.stack(first.observations), np.stack(second.observations)
        np.testing.assert_array_equal(states[: end + 1], others[: end + 1])
        assert not np.array_equal(states[end + 1], others[end + 1])
        np.testing.assert_array_equal(
            states[: end - 1], np.stack(clean.observations)[: end - 1]
        )
        assert abs(played[BEHAVIOR].disturbed.forces[episode]) == 50
        assert len(played["other"].disturbed.poses[episode]) == len(others)
    assert played[BEHAVIOR].up_clean(ends, 4) == [0, 1, 2]
    never = torch.tensor([NEVER, 5, 5])
    assert played[BEHAVIOR].up_clean(never, 4) == [1, 2]


def test_steps_alive_do_not_count_the_fall():
    # Entry 10 is the moment; the last of 31 entries is number 30.
    assert steps_alive(trajectory(31, terminated=False), 10, 20) == 20
    assert steps_alive(trajectory(31, terminated=True), 10, 20) == 19
    assert steps_alive(trajectory(31, terminated=True), 10, 15) == 15
    assert steps_alive(trajectory(8, terminated=True), 10, 15) == 0
    assert steps_alive(trajectory(31, terminated=False), NEVER, 20) == 0


def test_table_counts_by_horizon_and_in_pairs():
    first = Survival((5, 10), [0.0] * 4, [10, 10, 7, 0], [10] * 4, [None, 3, 5, 9])
    second = Survival((5, 10), [0.0] * 4, [10, 4, 10, 10], [10, 10, 9, 0], [None] * 4)
    assert first.up == [True, True, False, False]
    lines = survival_table({"first": first, "second": second}).splitlines()
    assert lines[1].split() == ["first", "3", "2", "15-85", "%", "4", "3", "in", "5"]
    assert lines[2].split() == ["second", "3", "3", "30-95", "%", "2", "0", "2/1"]
