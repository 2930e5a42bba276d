"""Elites for acting, and switching in worlds in which the best policy is known."""

from __future__ import annotations

import torch
from torch import Tensor
from uneven_dynamics import linear_dynamics

from torchrl_osr.lab.dynamics import DynamicsEnsemble, EliteNetworks, SwitchingPolicy


def cart(*bias: float, elites: int = 1) -> DynamicsEnsemble:
    """Position and velocity ``[x, v]``; the action accelerates, a bias pushes.

    One network for each bias. ``x`` rises by ``v`` and ``v`` by the action; the reward
    is ``v`` before that.
    """
    weights = {(1, 0): 1.0, (2, 1): 1.0, (1, 2): 1.0}
    model = linear_dynamics((2, 1), weights, (len(bias), elites))
    model.layers[0].bias[:, 0, 1] = torch.tensor(bias)
    return model


def left(state: Tensor) -> Tensor:
    return torch.full_like(state[:, :1], -1.0)


def right(state: Tensor) -> Tensor:
    return torch.full_like(state[:, :1], 1.0)


def test_returns_are_discounted_rewards_and_the_value_of_the_last_state() -> None:
    # One network is pushed by 1, one by -1; the third is no elite.
    parts = [EliteNetworks(cart(1.0, -1.0, 50.0, elites=2)), EliteNetworks(cart(0.0))]
    switching = SwitchingPolicy(
        [left, right], EliteNetworks.join(parts),
        value=lambda state, action: 100 * state[:, 0] + action[:, 0],
        terminated=lambda state: state[:, 1] > 3.5, steps=2, gamma=0.5,
    )  # fmt: skip
    # From x = 0, v = 1. To the left: v = 1, 1, 1, hence x = 2; v = 1, -1, -3, x = 0;
    # v = 1, 0, -1, x = 1. Rewards are v of both steps, the value is at the end:
    first = [1.5 + 199 / 4, 0.5 - 1 / 4, 1.0 + 99 / 4]
    # To the right: v = 1, 3, and 5 has ended; 1, 1, 1, x = 2; 1, 2, 3, x = 3.
    second = [2.5, 1.5 + 201 / 4, 2.0 + 301 / 4]
    wanted = torch.tensor([[sum(first) / 3, sum(second) / 3]])
    state = torch.tensor([[0.0, 1.0]])
    torch.testing.assert_close(switching.returns(state), wanted)
    assert switching(state).item() == 1.0
    assert switching.chosen.tolist() == [1]


def test_a_choice_holds_until_it_is_reset_or_the_number_of_states_changes() -> None:
    calls = []

    def value(state: Tensor, action: Tensor) -> Tensor:
        calls.append(len(state))
        return state[:, 0] * action[:, 0]

    switching = SwitchingPolicy([left, right], None, value, hold=3)
    there, here = torch.tensor([[1.0, 0.0]]), torch.tensor([[-1.0, 0.0]])
    acted = [switching(state).item() for state in (there, here, here, here)]
    assert acted == [1.0, 1.0, 1.0, -1.0]
    switching.reset()
    assert switching(there).item() == 1.0
    assert switching(torch.cat([here, there])).flatten().tolist() == [-1.0, 1.0]
    assert calls == [2, 2, 2, 4]


def test_a_model_that_breaks_down_ends_the_task() -> None:
    model = EliteNetworks(cart(torch.inf))
    switching = SwitchingPolicy([left], model, lambda state, action: state[:, 1])
    torch.testing.assert_close(switching.returns(torch.ones(1, 2)), torch.zeros(1, 1))


def ensemble(*elites: int) -> DynamicsEnsemble:
    sizes = {"num_networks": 4, "num_elites": len(elites), "num_cells": [8, 8]}
    model = DynamicsEnsemble(3, 2, **sizes)
    model.elites.copy_(torch.tensor(elites))
    for name in ("input", "target"):
        getattr(model, f"{name}_loc").normal_()
        getattr(model, f"{name}_scale").uniform_(0.5, 2.0)
    return model


def test_elite_networks_predict_means_in_the_environments_units() -> None:
    model, loc = ensemble(1, 3), torch.tensor([1.0, -2.0, 300.0])
    scale = torch.tensor([2.0, 0.5, 40.0])
    low, high = torch.tensor([-2.0, 0.5]), torch.tensor([4.0, 1.5])
    networks = EliteNetworks(model, loc, scale, low, high)
    seen, unit = torch.randn(5, 3), 2 * torch.rand(5, 2) - 1
    mean = model.predict(seen, unit)[0][[1, 3]]
    wanted = torch.cat([mean[..., :3] * scale, mean[..., 3:]], -1)
    state, action = seen * scale + loc, low + (unit + 1) / 2 * (high - low)
    found = networks(state.expand(2, -1, -1), action.expand(2, -1, -1))
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    other = EliteNetworks(ensemble(0))
    other.limits[1, 0] = 2.0
    both = EliteNetworks.join([other, networks])
    assert both.limits.isfinite().sum() == 1
    state, action = torch.randn(3, 5, 3), torch.randn(3, 5, 2)
    wanted = torch.cat([other(state[:1], action[:1]), networks(state[1:], action[1:])])
    torch.testing.assert_close(both(state, action), wanted)


class Doubling:
    """A body that doubles states, and shows them up to 1."""

    def in_own_units(self) -> Doubling:
        return self

    def __call__(self, state: Tensor, action: Tensor) -> Tensor:
        return 2 * state

    def observed(self, state: Tensor) -> Tensor:
        return state.clamp(max=1.0)


def test_of_a_grey_box_one_network_adds_to_the_body() -> None:
    model = ensemble(1, 3)
    state, action = torch.randn(1, 5, 3), torch.randn(1, 5, 2)
    left_over = model.predict(state[0], action[0])[0][1]
    model.body = Doubling()
    networks = EliteNetworks(model)
    found = networks(state, action)
    wanted = left_over + torch.cat([state[0], torch.zeros(5, 1)], -1)
    torch.testing.assert_close(found, wanted[None], rtol=1e-4, atol=1e-4)
    assert networks.observed(2 * torch.ones(1, 3)).tolist() == [[1.0] * 3]
