"""InverseDynamicsLoss against a plain likelihood, and what it learns from data."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal

from torchrl_osr import InverseDynamicsLoss
from torchrl_osr.functional import gaussian_kl

# float64 tensors, because TorchRL keeps bounds given as numbers in float32.
BOUNDS = [([-1.0, -1.0], [1.0, 1.0]), ([-1.0, -2.0], [2.0, 1.0])]


def plain_loss(network, batch, states: str, low, high) -> torch.Tensor:
    """-log I(a | s~, s') by the change of variables, over rows that are not done."""
    s, s_next = batch["observation"], batch["next", "observation"]
    valid = ~batch["next", "done"].squeeze(-1)
    sets = [s] if states == "clean" else [s, batch["perturbed", "observation"]]
    center, half = (high + low) / 2, (high - low) / 2
    squashed = (batch["action"] - center) / half
    total = 0.0
    for state in sets:
        _, loc, scale = network[0](state, s_next)
        log_prob = Normal(loc, scale).log_prob(torch.atanh(squashed))
        log_prob = log_prob - torch.log(half * (1 - squashed**2))
        total = total - log_prob.sum(-1)[valid].mean()
    return total / len(sets)


@pytest.mark.parametrize("states", ["both", "clean"])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_loss_and_gradients_equal_the_plain_likelihood(
    make_networks, make_batch, states, low, high
) -> None:
    bounds = {"low": torch.tensor(low).double(), "high": torch.tensor(high).double()}
    plain = make_networks(**bounds).inverse_dynamics
    loss = InverseDynamicsLoss(make_networks(**bounds).inverse_dynamics, states=states)
    batch = make_batch(10)
    value = loss(batch)["loss_inverse_dynamics"]
    expected = plain_loss(plain, batch, states, **bounds)
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-9)
    value.backward()
    expected.backward()
    for got, wanted in zip(loss.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(got.grad, wanted.grad, rtol=1e-6, atol=1e-9)


def test_clean_states_need_no_perturbed_entry(make_networks, make_batch) -> None:
    loss = InverseDynamicsLoss(make_networks().inverse_dynamics, states="clean")
    with_twin, without = loss(make_batch(10)), loss(make_batch(10, twin=False))
    key = "loss_inverse_dynamics"
    assert torch.equal(with_twin[key], without[key])
    assert all(key[0] != "perturbed" for key in loss.in_keys)


def test_the_users_network_is_the_one_that_learns(make_networks, make_batch) -> None:
    network = make_networks().inverse_dynamics
    loss = InverseDynamicsLoss(network)
    loss(make_batch(10))["loss_inverse_dynamics"].backward()
    gradients = [parameter.grad for parameter in network.parameters()]
    assert len(gradients) == 4
    assert all(gradient.count_nonzero() > 0 for gradient in gradients)


def test_likelihood_recovers_a_linear_gaussian_world(make_networks, make_batch) -> None:
    # u ~ N(-.3 s, .4^2) drives s' = .9 s + .5 u + N(0, .1^2) in each of two dimensions,
    # a = tanh(u). By Gaussian conditioning, with gain G = .5 * .16/(.01 + .25 * .16):
    # I(u | s, s') = N(-.3 s + G (s' - .75 s), .16 * .01/.05).
    gain, std = 1.6, 0.032**0.5
    size = 4096
    state = torch.randn(size, 3, dtype=torch.float64)
    latent = -0.3 * state[:, :2] + 0.4 * torch.randn(size, 2, dtype=torch.float64)
    following = 0.9 * state
    following[:, :2] += 0.5 * latent
    following += 0.1 * torch.randn(size, 3, dtype=torch.float64)
    batch = make_batch(size, twin=False)
    batch["observation"], batch["action"] = state, torch.tanh(latent)
    batch["next", "observation"] = following
    network = make_networks().inverse_dynamics
    loss = InverseDynamicsLoss(network, states="clean")
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 400)
    for _ in range(400):
        optimizer.zero_grad()
        loss(batch)["loss_inverse_dynamics"].backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        _, loc, scale = network[0](state, following)
    wanted = -0.3 * state + gain * (following - 0.75 * state)
    divergence = gaussian_kl(wanted[:, :2], torch.tensor(std), loc, scale)
    # A model that ignores s' would be at half the mutual information, log(5)/2.
    assert divergence.mean().item() < 0.03 < math.log(5) / 2


@pytest.mark.parametrize("states", ["perturbed", None])
def test_unknown_state_sets_are_rejected(make_networks, states) -> None:
    with pytest.raises(ValueError, match="states must be one of"):
        InverseDynamicsLoss(make_networks().inverse_dynamics, states=states)
