"""The rules by which tasks end, against the simulators' own."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.dynamics import termination


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"])
def test_rules_are_the_simulators(env_id) -> None:
    env = make_environment(env_id)
    env.reset(seed=0)
    bare, generator = env.unwrapped, np.random.default_rng(0)
    states, ended = [], []
    for _ in range(300):
        position, velocity = np.array(bare.init_qpos), np.array(bare.init_qvel)
        position[1:3] += generator.uniform([-1.2, -1.2], [1.2, 1.2])
        velocity += generator.normal(0, 2, velocity.shape)
        bare.set_state(position, velocity)
        state, _, terminated, _, _ = bare.step(env.action_space.sample())
        states.append(state)
        ended.append(terminated)
    env.close()
    found = termination(env_id)(torch.tensor(np.array(states)))
    assert found.tolist() == ended
    assert (0 < sum(ended) < 300) == (env_id != "HalfCheetah-v5")


def test_states_that_are_no_numbers_end_hopper() -> None:
    assert termination("Hopper-v5")(torch.full([2, 11], float("nan"))).all()


@pytest.mark.parametrize("env_id", ["PointMaze_UMaze-v3", "Pendulum-v1", "mine:Hop-v0"])
def test_a_task_without_a_rule_is_named(env_id) -> None:
    with pytest.raises(ValueError, match=rf"{env_id} ends.*terminations=never"):
        termination(env_id)
