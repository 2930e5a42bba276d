"""Actors: shapes, bounds, and scales that have a floor."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv

from torchrl_osr import modules

BOUNDED = [modules.tanh_gaussian_actor, modules.tanh_gaussian_inverse_dynamics]
BOUNDS = [(-0.4, 0.4), (torch.tensor([-1.0, 0.0]), torch.tensor([2.0, 3.0]))]


def states(*size: int, scale: float = 1.0) -> TensorDict:
    observation, next_observation = scale * torch.randn(2, *size, 5)
    next_states = {"observation": next_observation}
    return TensorDict({"observation": observation, "next": next_states}, size)


@pytest.mark.parametrize("build", [*BOUNDED, modules.deterministic_actor])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_actions_fill_their_bounds_and_never_leave_them(build, low, high) -> None:
    # Inputs of this size saturate the tanh at both ends.
    out = build(5, 2, num_cells=[8], low=low, high=high)(states(500, scale=300))
    action, low, high = out["action"], torch.as_tensor(low), torch.as_tensor(high)
    assert (action >= low).all()
    assert (action <= high).all()
    width = high - low
    assert (action.amin(0) < low + 0.1 * width).all()
    assert (action.amax(0) > high - 0.1 * width).all()


@pytest.mark.parametrize("build", [*BOUNDED, modules.deterministic_actor])
def test_an_untrained_actor_acts_near_the_center(build) -> None:
    action = build(5, 2, num_cells=[8], low=0.0, high=100.0)(states(500))["action"]
    assert 35 < action.mean() < 65


@pytest.mark.parametrize("build", BOUNDED)
def test_scale_has_a_floor(build) -> None:
    # The KL divides by the variance: 1e-2 is as sure as a network can get.
    scale = build(5, 2, num_cells=[8]).get_dist(states(500, scale=1e4)).scale
    assert scale.min().item() == pytest.approx(1e-2)


def test_mean_of_a_gaussian_is_bounded_and_its_scale_is_learned() -> None:
    out = modules.gaussian_actor(5, 2, num_cells=[8])(states(4, scale=100))
    assert (out["loc"].abs() <= 1).all()
    assert (out["scale"] == 1).all()
    assert out["scale"].requires_grad


def test_categorical_actor_plays_a_gymnasium_task_as_torchrl_gives_it() -> None:
    env = GymEnv("CartPole-v1")
    rollout = env.rollout(5, modules.categorical_actor(4, 2, num_cells=[8]))
    assert env.action_spec.is_in(rollout["action"][0].to(env.action_spec.dtype))
    env.close()
