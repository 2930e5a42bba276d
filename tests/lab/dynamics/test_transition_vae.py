"""TransitionVAELoss against BCQ's objective written out, row by row."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_osr.lab.dynamics import TransitionVAE, TransitionVAELoss


def make_model() -> TransitionVAE:
    torch.manual_seed(0)
    model = TransitionVAE(3, num_cells=[6])
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    return model.double()


def test_loss_and_gradients_equal_the_plain_objective(make_batch, check) -> None:
    batch = make_batch(10, twin=False)
    batch["next", "observation"][1] = batch["observation"][1]  # terminated: no next
    model, plain = make_model(), make_model()
    model.standardize_(batch)
    loss = TransitionVAELoss(model, latent_weight=0.3)
    torch.manual_seed(3)
    value = loss(batch)["loss_vae"]
    torch.manual_seed(3)
    noise = torch.randn(10, 6, dtype=torch.float64)
    total, kept = 0.0, [row for row in range(10) if row != 1]
    change = (batch["next", "observation"] - batch["observation"])[kept]
    targets = (change - change.mean(0)) / change.std(0, correction=0)
    for row, target in zip(kept, targets, strict=True):
        state = batch["observation"][row]
        first, last = plain.encoder[0], plain.encoder[2]
        hidden = (first.weight @ torch.cat([state, target]) + first.bias).relu()
        mean, log_scale = (last.weight @ hidden + last.bias).split(6)
        latent = mean + log_scale.exp() * noise[row]
        first, last = plain.decoder[0], plain.decoder[2]
        hidden = (first.weight @ torch.cat([state, latent]) + first.bias).relu()
        out = last.weight @ hidden + last.bias
        variance = (2 * log_scale).exp()
        divergence = (variance + mean**2 - 1 - 2 * log_scale).sum() / 2
        total = total + ((out - target) ** 2).mean() + 0.3 * divergence / 6
    wanted = total / len(kept)
    check(
        "Transition VAE",
        [value.detach(), *torch.autograd.grad(value, list(model.parameters()))],
        [wanted.detach(), *torch.autograd.grad(wanted, list(plain.parameters()))],
        tolerance=1e-10,
    )


def test_rows_are_single_steps(make_batch) -> None:
    batch = make_batch(10, twin=False)
    batch["steps_to_next_obs"] = torch.full((10, 1), 5)
    with pytest.raises(ValueError, match="the autoencoder reads the state one step"):
        TransitionVAELoss(make_model())(batch)
