"""InverseDynamicsLoss against a plain likelihood, and what it learns from data."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch.distributions import Categorical, Normal, kl_divergence

from torchrl_osr import InverseDynamicsLoss
from torchrl_osr.functional import gaussian_kl
from torchrl_osr.modules import (
    categorical_inverse_dynamics,
    cvae_inverse_dynamics,
    tanh_gaussian_inverse_dynamics,
)

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


def with_gradients(value: torch.Tensor, parameters) -> list[torch.Tensor]:
    return [value.detach(), *torch.autograd.grad(value, list(parameters))]


@pytest.mark.parametrize("states", ["both", "clean"])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_loss_and_gradients_equal_the_plain_likelihood(
    make_networks, make_batch, check, states, low, high
) -> None:
    bounds = {"low": torch.tensor(low).double(), "high": torch.tensor(high).double()}
    plain = make_networks(**bounds).inverse_dynamics
    loss = InverseDynamicsLoss(make_networks(**bounds).inverse_dynamics, states=states)
    batch = make_batch(10)
    value = loss(batch)["loss_inverse_dynamics"]
    expected = plain_loss(plain, batch, states, **bounds)
    got = with_gradients(value, loss.parameters())
    wanted = with_gradients(expected, plain.parameters())
    check("Inverse dynamics", got, wanted, tolerance=1e-12)


KEY = "loss_inverse_dynamics"
LATENT = "Inverse dynamics, conditional VAE"


def make_cvae(**kwargs):
    torch.manual_seed(0)
    return cvae_inverse_dynamics(3, 2, latent_dim=4, num_cells=[8], **kwargs).double()


def seeded(loss, batch) -> torch.Tensor:
    torch.manual_seed(2)
    return loss(batch)[KEY]


def state_sets(batch, states: str) -> torch.Tensor:
    """State and next state side by side, ``[1 or 2, B, 6]``: clean, then perturbed."""
    sets = [batch["observation"]]
    if states == "both":
        sets.append(batch["perturbed", "observation"])
    following = batch["next", "observation"]
    return torch.stack([torch.cat([state, following], -1) for state in sets])


def plain_cvae(network, pairs) -> tuple[torch.Tensor, ...]:
    """The conditional VAE by hand: loc and scale of action and latent, z drawn."""
    core = network.module[0].module
    latent_loc, log_scale = core.encoder(pairs).chunk(2, -1)
    latent_scale = log_scale.exp()
    z = latent_loc + latent_scale * torch.randn_like(latent_loc)
    loc, free = core.decoder(torch.cat([pairs, z], -1)).chunk(2, -1)
    # A softplus that is 1 at 0, above a floor of .01; its shift is a float32 number.
    shift = torch.tensor(0.99).expm1().log().item()
    return loc, torch.nn.functional.softplus(free + shift) + 0.01, latent_loc, log_scale


@pytest.mark.parametrize("states", ["both", "clean"])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
@pytest.mark.parametrize("latent", [False, True])
def test_mse_equals_the_plain_squared_error_of_the_same_draws(
    make_networks, make_batch, check, states, low, high, latent
) -> None:
    low, high = torch.tensor(low).double(), torch.tensor(high).double()
    bounds = {"low": low, "high": high}
    if latent:
        network, plain = make_cvae(**bounds), make_cvae(**bounds)
    else:
        network, plain = (make_networks(**bounds).inverse_dynamics for _ in range(2))
    loss = InverseDynamicsLoss(network, states=states, loss_function="mse")
    batch = make_batch(10)
    value = seeded(loss, batch)
    torch.manual_seed(2)
    pairs, penalty = state_sets(batch, states), 0.0
    if latent:
        loc, scale, latent_loc, log_scale = plain_cvae(plain, pairs)
        # As the authors write it.
        penalty = 1 + 2 * log_scale - latent_loc**2 - (2 * log_scale).exp()
        penalty = -0.5 * penalty.mean(-1)
    else:
        _, loc, scale = plain[0](*pairs.split(3, -1))
    sample = torch.tanh(loc + scale * torch.randn_like(loc))
    action = (high + low) / 2 + (high - low) / 2 * sample
    rows = (action - batch["action"]).square().mean(-1) + 0.5 * penalty
    expected = rows[:, ~batch["next", "done"].squeeze(-1)].mean()
    got = with_gradients(value, loss.parameters())
    wanted = with_gradients(expected, plain.parameters())
    check(LATENT if latent else "Inverse dynamics", got, wanted, tolerance=1e-12)


@pytest.mark.parametrize("loss_function", ["nll", "mse"])
def test_latent_adds_its_divergence_from_the_prior(
    make_batch, check, loss_function
) -> None:
    batch = make_batch(10)
    network, plain = make_cvae(), make_cvae()

    def make(weight: float) -> InverseDynamicsLoss:
        return InverseDynamicsLoss(
            network, loss_function=loss_function, latent_weight=weight
        )

    heavy = make(3.0)
    value = seeded(heavy, batch) - seeded(make(0.0), batch)
    _, _, loc, log_scale = plain_cvae(plain, state_sets(batch, "both"))
    divergence = kl_divergence(Normal(loc, log_scale.exp()), Normal(0.0, 1.0))
    valid = ~batch["next", "done"].squeeze(-1)
    expected = 3.0 * divergence[:, valid].mean()
    encoder, plain_encoder = (net.module[0].module.encoder for net in (network, plain))
    got = with_gradients(value, encoder.parameters())
    wanted = with_gradients(expected, plain_encoder.parameters())
    check(LATENT, got, wanted, tolerance=1e-12)


def test_without_a_latent_nothing_is_drawn_and_no_bit_differs(
    make_networks, make_batch
) -> None:
    network, batch = make_networks().inverse_dynamics, make_batch(10)
    pairs = batch.select(*network.in_keys)
    perturbed = pairs.clone()
    perturbed["observation"] = batch["perturbed", "observation"]
    distribution = network.get_dist(torch.stack([pairs, perturbed]))
    rows = -distribution.log_prob(batch["action"].expand(2, 10, 2)).mean(0)
    expected = rows[~batch["next", "done"].squeeze(-1)].mean()
    state = torch.get_rng_state()
    for kwargs in ({}, {"latent_weight": 7.0}, {"loss_function": "nll"}):
        loss = InverseDynamicsLoss(network, **kwargs)
        assert torch.equal(loss(batch)[KEY], expected)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("ambient", [InteractionType.DETERMINISTIC, None])
def test_training_draws_the_latent_whatever_the_ambient_type(
    make_batch, ambient
) -> None:
    loss, batch = InverseDynamicsLoss(make_cvae()), make_batch(10)
    with set_interaction_type(InteractionType.RANDOM):
        expected = seeded(loss, batch)
    with set_interaction_type(ambient):
        assert torch.equal(seeded(loss, batch), expected)
        assert not torch.equal(loss(batch)[KEY], expected)


def linear_world(make_batch, size: int):
    """Transitions, and mean and standard deviation of u = atanh(a) given (s, s').

    u ~ N(-.3 s, .4^2) drives s' = .9 s + .5 u + N(0, .1^2) in each of two dimensions.
    By Gaussian conditioning, with gain G = .5 * .16/(.01 + .25 * .16) = 1.6:
    I(u | s, s') = N(-.3 s + G (s' - .75 s), .16 * .01/.05).
    """
    state = torch.randn(size, 3, dtype=torch.float64)
    latent = -0.3 * state[:, :2] + 0.4 * torch.randn(size, 2, dtype=torch.float64)
    following = 0.9 * state
    following[:, :2] += 0.5 * latent
    following += 0.1 * torch.randn(size, 3, dtype=torch.float64)
    batch = make_batch(size, twin=False)
    batch["observation"], batch["action"] = state, torch.tanh(latent)
    batch["next", "observation"] = following
    loc = -0.3 * state + 1.6 * (following - 0.75 * state)
    return batch, loc[:, :2], torch.tensor(0.032**0.5)


def fit(network, batch, **kwargs):
    """Train by Adam; return loc and scale, a latent at its mean."""
    loss = InverseDynamicsLoss(network, states="clean", **kwargs)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 400)
    for _ in range(400):
        optimizer.zero_grad()
        loss(batch)[KEY].backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        distribution = network.get_dist(batch.select(*network.in_keys))
    return distribution.loc, distribution.scale


BUILDERS = [
    tanh_gaussian_inverse_dynamics,
    partial(cvae_inverse_dynamics, latent_dim=4),
]
MODELS = pytest.mark.parametrize("build", BUILDERS, ids=["plain", "latent"])


@MODELS
def test_likelihood_recovers_a_linear_gaussian_world(make_batch, build) -> None:
    batch, *wanted = linear_world(make_batch, 2048)
    network = build(3, 2, num_cells=[8]).double()
    divergence = gaussian_kl(*wanted, *fit(network, batch))
    # A model that ignores s' would be at half the mutual information, log(5)/2.
    assert divergence.mean().item() < 0.03 < math.log(5) / 2


@MODELS
def test_mse_recovers_the_mean_action_but_not_its_spread(make_batch, build) -> None:
    batch, loc, std = linear_world(make_batch, 2048)
    network = build(3, 2, num_cells=[8]).double()
    found, scale = fit(network, batch, loss_function="mse")
    # E[tanh(u) | s, s'] by Gauss-Hermite quadrature: the least squares' answer.
    nodes, weights = map(torch.from_numpy, np.polynomial.hermite_e.hermegauss(20))
    mean = (torch.tanh(loc[..., None] + std * nodes) * weights).sum(-1) / weights.sum()
    error = (torch.tanh(found) - mean).square().mean().item()
    assert error < 0.01 * mean.var().item()
    # As the documentation warns: the noise of the data is .18, the floor is .01.
    assert scale.mean().item() < 0.05 < std.item()


@pytest.mark.parametrize("one_hot", [True, False])
@pytest.mark.parametrize("states", ["both", "clean"])
def test_discrete_loss_and_gradients_equal_the_cross_entropy(
    make_discrete_networks, make_discrete_batch, check, one_hot, states
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    network = make_discrete_networks(**kwargs).inverse_dynamics
    mlp, batch = network[0].module, make_discrete_batch(10)
    index, done = batch["action"].argmax(-1), batch["next", "done"].squeeze(-1)
    pairs = state_sets(batch, states)[:, ~done]
    log_prob = Categorical(logits=mlp(pairs)).log_prob(index[~done])
    wanted = with_gradients(-log_prob.mean(), mlp.parameters())
    if not one_hot:
        batch["action"] = index
    loss = InverseDynamicsLoss(network, states=states)
    got = with_gradients(loss(batch)[KEY], loss.parameters())
    check("Discrete inverse dynamics", got, wanted, tolerance=1e-12)


def test_likelihood_recovers_a_noisy_table() -> None:
    # s' tells which of two actions was taken in three cases of four.
    action = torch.tensor([0, 0, 0, 1, 1, 1, 1, 0]).repeat(8)
    seen = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1]).repeat(8)
    following = {"observation": torch.eye(2)[seen], "done": torch.zeros(64, 1).bool()}
    batch = TensorDict(
        {
            "observation": torch.zeros(64, 2),
            "action": torch.nn.functional.one_hot(action, 2),
            "next": following,
        },
        [64],
    )
    model = categorical_inverse_dynamics(2, 2, num_cells=[8])
    loss = InverseDynamicsLoss(model, states="clean")
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.05)
    for _ in range(150):
        optimizer.zero_grad()
        loss(batch)[KEY].backward()
        optimizer.step()
    # The entropy of (3/4, 1/4).
    assert loss(batch)[KEY].item() == pytest.approx(0.5623351, abs=1e-3)
    probs = model.get_dist(batch).probs
    wanted = torch.where(seen.bool(), 0.75, 0.25)
    torch.testing.assert_close(probs[:, 1], wanted, rtol=0, atol=0.02)
