"""InverseDynamicsLoss against a plain likelihood, and what it learns from data."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch
from objectives.plain import BOX, Plain, compare
from torch import Tensor
from torch.distributions import Categorical, Normal, kl_divergence

from torchrl_osr import InverseDynamicsLoss

KEY = "loss_inverse_dynamics"
TRAINED = f"{KEY} inverse_dynamics"
STATES = {"clean": slice(0, 1), "both": slice(0, 2)}


def kept_pairs(batch, states: str) -> tuple[Tensor, Tensor]:
    """Return states and next states side by side, ``[D, R, 6]``, and the rows kept."""
    both = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    after = batch["next", "observation"].expand_as(both)
    valid = ~batch["next", "done"].squeeze(-1)
    return torch.cat([both, after], -1)[STATES[states]], valid


@pytest.mark.parametrize("head", [None, Categorical])
def test_discrete_loss_and_gradients_equal_the_cross_entropy(check, head) -> None:
    networks = Networks(head=head) if head else Networks()
    plain, batch = Networks().choice_model, make_batch("choice-model", 10)
    pairs, valid = kept_pairs(batch, "both")
    index = batch["action"].argmax(-1)
    log_prob = Categorical(logits=plain[0](*pairs.split(3, -1))).log_prob(index)
    if head:
        batch["action"] = index
    loss = InverseDynamicsLoss(networks.choice_model)
    expected = {KEY: -log_prob.mean(0)[valid].mean()}
    compare(check, "discrete", loss, batch, lambda: expected, {TRAINED: plain})


def plain_cvae(network, pairs: Tensor) -> tuple[Tensor, ...]:
    """Return loc and scale of action and latent, with the latent drawn."""
    core = network.module[0].module
    latent_loc, log_scale = core.encoder(pairs).chunk(2, -1)
    z = latent_loc + log_scale.exp() * torch.randn_like(latent_loc)
    loc, free = core.decoder(torch.cat([pairs, z], -1)).chunk(2, -1)
    # A softplus that is 1 at 0, above a floor of .01; its shift is a float32 number.
    shift = torch.tensor(0.99).expm1().log().item()
    scale = torch.nn.functional.softplus(free + shift) + 0.01
    return loc, scale, latent_loc, log_scale.exp()


@pytest.mark.parametrize("states", STATES)
@pytest.mark.parametrize("latent", [False, True])
@pytest.mark.parametrize("function", ["mse", "nll"])
def test_losses_and_gradients_equal_the_plain_ones(check, states, latent, function):
    kind = "latent_model" if latent else "model"
    network, plain = (getattr(Networks(**BOX), kind) for _ in range(2))
    batch = make_batch("model", 10)
    options = {"loss_function": function, "latent_weight": 3.0, "states": states}
    loss = InverseDynamicsLoss(network, **options)
    assert (("perturbed", "observation") in loss.in_keys) == (states == "both")
    pairs, valid = kept_pairs(batch, states)
    helper = Plain(Networks(**BOX))
    torch.manual_seed(5)  # as compare() does
    if latent:
        *found, latent_loc, latent_scale = plain_cvae(plain, pairs)
        prior = kl_divergence(Normal(latent_loc, latent_scale), Normal(0.0, 1.0))
    else:
        found, prior = plain[0](*pairs.split(3, -1))[-2:], torch.zeros(1, 10, 1)
    gaussian = Normal(*found)
    if function == "mse":
        action, _ = helper.act(gaussian, torch.randn_like(gaussian.loc))
        rows = (action - batch["action"]).square().mean(-1)
    else:
        rows = -helper.log_prob(gaussian, batch["action"])
    expected = {KEY: (rows + 3.0 * prior.mean(-1)).mean(0)[valid].mean()}
    compare(check, function, loss, batch, lambda: expected, {TRAINED: plain})
