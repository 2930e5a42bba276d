"""ConditionalVAELoss against BCQ's objective written out, and the model's samples."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_osr.lab.dynamics import ConditionalVAE, ConditionalVAELoss

NEXT = ("next", "observation")
CHANGE = {"condition_key": "observation", "target_key": NEXT, "change": True}
KINDS = {
    "action": (2, {"condition_key": NEXT, "target_key": "action"}),
    "change": (3, CHANGE),
}


def make_model(kind: str, **options) -> ConditionalVAE:
    torch.manual_seed(0)
    size, keys = KINDS[kind]
    model = ConditionalVAE(3, size, num_cells=[6], latent_dim=2, **keys, **options)
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    return model.double()


@pytest.mark.parametrize("kind", KINDS)
def test_loss_and_gradients_equal_the_plain_objective(make_batch, check, kind) -> None:
    batch = make_batch(10, twin=False)
    batch["next", "observation"][1] = batch["observation"][1]  # terminated: no next
    model, plain = make_model(kind), make_model(kind)
    if kind == "change":
        for each in (model, plain):
            each.standardize_(batch)
    loss = ConditionalVAELoss(model, latent_weight=0.3)
    torch.manual_seed(3)
    value = loss(batch)["loss_vae"]
    torch.manual_seed(3)
    noise = torch.randn(10, 2, dtype=torch.float64)
    total, kept = 0.0, [row for row in range(10) if row != 1]
    change = (batch["next", "observation"] - batch["observation"])[kept]
    for row in kept:
        state, after = batch["observation"][row], batch["next", "observation"][row]
        condition, target = after, batch["action"][row]
        if kind == "change":
            spread = change.std(0, correction=0)
            condition, target = state, (after - state - change.mean(0)) / spread
        first, last = plain.encoder[0], plain.encoder[2]
        hidden = (first.weight @ torch.cat([condition, target]) + first.bias).relu()
        mean, log_scale = (last.weight @ hidden + last.bias).split(2)
        latent = mean + log_scale.exp() * noise[row]
        first, last = plain.decoder[0], plain.decoder[2]
        hidden = (first.weight @ torch.cat([condition, latent]) + first.bias).relu()
        out = last.weight @ hidden + last.bias
        out = out if kind == "change" else torch.tanh(out)
        variance = (2 * log_scale).exp()
        divergence = (variance + mean**2 - 1 - 2 * log_scale).sum() / 2
        total = total + ((out - target) ** 2).mean() + 0.3 * divergence / 2
    wanted = total / len(kept)
    check(
        "Conditional VAE",
        [value.detach(), *torch.autograd.grad(value, list(model.parameters()))],
        [wanted.detach(), *torch.autograd.grad(wanted, list(plain.parameters()))],
        tolerance=1e-10,
    )


def test_latents_are_within_the_bound_and_rows_are_single_steps(make_batch) -> None:
    model, batch = make_model("action", latent_bound=0.0), make_batch(10, twin=False)
    drawn = model.sample(torch.ones(5, 3, dtype=torch.float64))
    assert (drawn == drawn[0]).all()
    batch["steps_to_next_obs"] = torch.full((10, 1), 5)
    with pytest.raises(ValueError, match="the autoencoder reads the state one step"):
        ConditionalVAELoss(model)(batch)
