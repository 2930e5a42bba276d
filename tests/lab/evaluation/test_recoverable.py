"""Which states a policy comes back from, in the environments themselves."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data import load_behavior_policy, make_environment
from torchrl_osr.lab.data.environment import known_ids
from torchrl_osr.lab.evaluation.recoverable import (
    GROUPS,
    HALVES,
    STATES,
    RecoverableStates,
    load_recoverable_states,
    recovers,
)


def states_of(env_name: str, states: list[tuple], **others) -> RecoverableStates:
    """States with the given positions and velocities."""
    qpos, qvel = (np.array(each, float) for each in zip(*states, strict=True))
    rest = {"goal": qpos[:, :0], "steps": 60, "least_speed": -np.inf} | others
    unused = dict.fromkeys(("group", "walk", "kind", "strength"))
    return RecoverableStates(env_name, qpos, qvel, **rest, **unused)


def test_who_falls_from_each_state_is_what_the_environment_says() -> None:
    env = make_environment("Walker2d-v5")
    env.reset(seed=0)
    bare = env.unwrapped
    rng = np.random.default_rng(0)
    # More than are played at once; some fall and some do not.
    pushes = 2.0 * rng.standard_normal((20, 9))
    states = [(bare.init_qpos, bare.init_qvel + push) for push in pushes]

    def policy(observation: Tensor) -> Tensor:
        # Rounds in the same way whatever the number of rows: falls are chaotic.
        return -0.1 * observation[:, 11:]

    def stands(qpos: np.ndarray, qvel: np.ndarray) -> bool:
        env.reset()
        bare.set_state(qpos, qvel)
        observation = bare._get_obs()
        for _ in range(60):
            rows = torch.from_numpy(observation[None]).float()
            action = policy(rows)[0].numpy()
            observation, _, terminated, _, _ = env.step(action)
            if terminated:
                return False
        return True

    expected = [stands(*state) for state in states]
    back = recovers(states_of("walker2d", states), policy)
    assert back.tolist() == expected
    assert 2 < sum(expected) < 18


def test_halfcheetah_has_to_regain_its_speed() -> None:
    state = np.zeros(9), np.zeros(9)
    states = states_of("halfcheetah", [state, state], least_speed=2.0, steps=100)
    behavior = load_behavior_policy("halfcheetah", "expert")

    def expert(observation: Tensor) -> Tensor:
        return torch.from_numpy(behavior.deterministic(observation.numpy()))

    assert recovers(states, expert).tolist() == [True, True]
    still = recovers(states, lambda rows: torch.zeros(len(rows), 6))
    assert still.tolist() == [False, False]
    fast = replace(states, least_speed=100.0)
    assert recovers(fast, expert).tolist() == [False, False]


def test_in_a_maze_the_goal_of_each_state_counts() -> None:
    env = make_environment(known_ids()["pointmaze-umaze"])
    start, _ = env.reset(seed=0)
    here = start[:2]
    # It rolls towards the first goal, stands at the second, and away from the third.
    states = [(here, [1.0, 0.0]), (here, [0.0, 0.0]), (here, [0.0, 0.0])]
    goals = np.stack([here] * 3)
    goals[:, 0] += [0.6, 0.0, 5.0]
    seen = []

    def policy(observation: Tensor) -> Tensor:
        seen.append(observation)
        return torch.zeros(len(observation), 2)

    back = recovers(states_of("pointmaze-umaze", states, goal=goals), policy)
    assert back.tolist() == [True, True, False]
    np.testing.assert_allclose(seen[0][:, 2:4], goals, atol=1e-6)
    np.testing.assert_allclose(seen[0][:, 4:6], np.stack([here] * 3), atol=1e-6)


@pytest.mark.parametrize("half", HALVES)
def test_the_states_that_ship_are_whole(half) -> None:
    sums = json.loads((STATES / "checksums.json").read_text())
    names = [path.name for path in STATES.glob(f"*-{half}.npz")]
    assert len(names) == (2 if half == "sealed" else 4)
    for name in names:
        assert sha256_of(STATES / name) == sums[name]
        states = load_recoverable_states(name.removesuffix(f"-{half}.npz"), half)
        assert {"recoverable"} < {*states.group} <= {*GROUPS}


@pytest.mark.parametrize("name", ["hopper", "walker2d"])
def test_the_sets_share_no_walk(name) -> None:
    sets = [{*load_recoverable_states(name, half).walk} for half in HALVES]
    assert len(set.union(*sets)) == sum(map(len, sets))
