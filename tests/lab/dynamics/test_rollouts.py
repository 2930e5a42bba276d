"""Rollouts in worlds that can be computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from uneven_dynamics import linear_dynamics

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.dynamics import DynamicsEnsemble, rollout, termination
from torchrl_osr.lab.dynamics.rollouts import perturbed_starts, task_limits


def linear_world(change=1.0, spread=0.0, log_variance=-40.0) -> DynamicsEnsemble:
    """The state grows by the action, plus or minus ``spread``; the reward is the state.

    Network 0 adds the spread, 1 subtracts it, 2 is far away and no elite.
    """
    weights = {(1, 0): change, (0, 1): 1.0}
    model = linear_dynamics((1, 1), weights, (3, 2), log_variance)
    model.layers[0].bias[:, 0, 0] = torch.tensor([spread, -spread, 1e6])
    return model


def one(state: Tensor) -> Tensor:
    return torch.ones_like(state)


def test_rows_are_those_of_a_known_world_until_the_task_ends() -> None:
    rows = rollout(
        linear_world(), one, torch.tensor([[0.0], [10.0]]), steps=3,
        terminated=lambda state: state[:, 0] == 12,
    )  # fmt: skip
    assert rows["observation"].flatten().tolist() == [0, 10, 1, 11, 2]
    after = rows["next", "observation"]
    torch.testing.assert_close(after, rows["observation"] + 1)
    torch.testing.assert_close(rows["next", "reward"], rows["observation"])
    assert torch.equal(rows["next", "terminated"], after == 12)
    assert torch.equal(rows["next", "done"], rows["next", "terminated"])
    assert not rows["next", "truncated"].any()


def test_unknown_rows_end_the_task() -> None:
    starts, world = torch.tensor([[2.0], [math.inf]]), linear_world(spread=0.5)
    assert len(rollout(world, one, starts, steps=3, max_disagreement=0.6)) == 3
    options = {"steps": 3, "max_disagreement": 0.4, "halt_reward": -7.0}
    rows = rollout(world, one, starts, **options)
    assert len(rows) == 1
    assert rows["next", "observation"].item() == 2
    assert rows["next", "reward"].item() == -7
    assert rows["next", "terminated"].all()
    with pytest.raises(ValueError, match="ends the task after every random action"):
        perturbed_starts(world, starts, **options)


def test_each_row_is_drawn_from_the_gaussian_of_an_elite() -> None:
    world = linear_world(spread=3.0, log_variance=math.log(0.25))
    rows = rollout(world, one, torch.zeros(20_000, 1), steps=1)
    change = rows["next", "observation"].flatten() - 1
    upper = change > 0
    # Gaussians of deviation .5 around 3 and -3; the third network is never used.
    assert upper.float().mean().item() == pytest.approx(0.5, abs=0.02)
    for side, mean in ((upper, 3.0), (~upper, -3.0)):
        found = [change[side].mean().item(), change[side].std().item()]
        assert found == pytest.approx([mean, 0.5], abs=0.02)


def test_perturbed_starts_are_where_random_actions_lead_in_the_task() -> None:
    states = perturbed_starts(linear_world(), torch.zeros(60_000, 1), steps=3)
    assert states.abs().max() <= 3
    # One, two or three draws from [-1, 1], whose variance is 1 / 3.
    assert states.mean().item() == pytest.approx(0, abs=0.02)
    assert states.var().item() == pytest.approx(2 / 3, rel=0.03)
    world, starts = linear_world(), torch.zeros(100, 1)
    states = perturbed_starts(world, starts, steps=5, terminated=lambda s: s[:, 0] < 0)
    assert (states >= 0).all()


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"])
def test_terminations_are_the_simulators(env_id) -> None:
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
    limits = torch.zeros(2, env.observation_space.shape[0])  # not used
    found = termination(env_id, limits)(torch.tensor(np.array(states)))
    assert found.tolist() == ended
    assert (0 < sum(ended) < 300) == (env_id != "HalfCheetah-v5")


def test_mazes_end_at_their_goal() -> None:
    env = make_environment("PointMaze_UMaze-v3")
    env.reset(seed=0)
    bare, generator = env.unwrapped, np.random.default_rng(0)
    states, ended = [], []
    for _ in range(100):
        place = bare.goal + generator.uniform(-0.6, 0.6, 2)
        bare.point_env.set_state(place, np.zeros(2))
        state, _, terminated, _, _ = env.step(env.action_space.sample())
        states.append(state)
        ended.append(terminated)
    env.close()
    rule = termination("PointMaze_UMaze-v3", torch.zeros(2, 8))
    assert rule(torch.tensor(np.array(states))).tolist() == ended
    assert 0 < sum(ended) < 100
    assert rule(torch.full([1, 8], math.nan)).all()


def test_a_hopper_that_is_not_a_number_has_fallen() -> None:
    state = torch.full([2, 11], float("nan"))
    assert termination("Hopper-v5", torch.zeros(2, 11))(state).all()


def walks(ended) -> TensorDict:
    """1,000 states in a square, and where ``ended`` of the first entry."""
    states = torch.rand(1000, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    after = {"observation": states, "terminated": ended(states[:, :1])}
    return TensorDict({"next": after}, [1000])


def test_other_tasks_end_beyond_the_states_from_which_they_go_on(capsys) -> None:
    limits = task_limits(walks(lambda where: where > 0.8), loc=1.0, scale=10.0)
    found = termination("mine:Hop-v0", limits)
    states = torch.tensor([[-99, 0], [0.5, 99], [0.95, 0]])
    assert found(states).tolist() == [False, False, True]
    said = capsys.readouterr().out
    assert "the task ends where observation[0] > 8.9" in said  # 10 s + 1
    assert task_limits(walks(lambda where: where > 2)).isinf().all()
    assert "the task ends never" in capsys.readouterr().out
    with pytest.raises(ValueError, match="0% of the log's ends .* expected 90 %"):
        task_limits(walks(lambda where: where.abs() < 0.1))  # a goal
