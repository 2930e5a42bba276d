"""Our reading of SDC against a plain restatement, row by row."""

from __future__ import annotations

import math

import pytest
import torch
from objectives.losses import Networks, make_batch
from objectives.plain import Plain, compare
from torch import Tensor
from uneven_dynamics import plain_gaussian, uneven_dynamics

from torchrl_osr.lab.losses import StateDeviationLoss

SAMPLES, WIDTH, THRESHOLD, MULTIPLIER = 3, 0.7, 0.02, 1.7


def kernel(first: Tensor, second: Tensor) -> Tensor:
    return torch.exp(-((first - second) ** 2).sum() / (2 * WIDTH**2 * 3))


def sampled_change(model, state: Tensor, action: Tensor, number: int, noise: Tensor):
    """Return a draw of the state's change from one network of an ensemble."""
    mean, variance = plain_gaussian(model, number, state, action)
    sample = (mean + variance.sqrt() * noise) * model.target_scale
    return (sample + model.target_loc)[:3]


def sampled_aim(vae, state: Tensor, latent: Tensor) -> Tensor:
    first, last = vae.decoder[0], vae.decoder[2]
    hidden = first.weight @ torch.cat([state, latent]) + first.bias
    out = last.weight @ hidden.clamp(min=0) + last.bias
    return state + vae.target_loc + vae.target_scale * out.detach()


def restated_sdc(plain: Plain, dynamics, vae, batch) -> Tensor:
    """Return the squared discrepancies, row by row and pair by pair."""
    rows, like = len(batch), {"dtype": torch.float64}
    action_noise = torch.randn(SAMPLES, 1, rows, 2, **like)[:, 0]
    drawn = torch.randint(2, (SAMPLES, rows))
    model_noise = torch.randn(SAMPLES, rows, 4, **like)
    latent = torch.randn(SAMPLES, rows, vae.latent_dim, **like)
    found = []
    for row in range(rows):
        state = batch["observation"][row]
        perturbed = batch["perturbed", "observation"][row]
        density, reached, aimed = plain.policy(perturbed), [], []
        for i in range(SAMPLES):
            action, _ = plain.act(density, action_noise[i, row])
            number = (0, 2)[drawn[i, row]]
            noise = model_noise[i, row]
            change = sampled_change(dynamics, perturbed, action, number, noise)
            reached.append(perturbed + change)
            aimed.append(sampled_aim(vae, state, latent[i, row]))
        value = 0.0
        for i in range(SAMPLES):
            for j in range(SAMPLES):
                value = value + kernel(reached[i], reached[j])
                value = value + kernel(aimed[i], aimed[j])
                value = value - 2 * kernel(reached[i], aimed[j])
        found.append(value / SAMPLES**2)
    return torch.stack(found)


def test_sdc_equals_the_restatement(check) -> None:
    networks, batch = Networks(), make_batch("sdc", 10)
    dynamics, vae, plain = uneven_dynamics(), networks.vae, Plain(networks)
    vae.target_scale.uniform_(0.5, 2)
    options = {"num_samples": SAMPLES, "kernel_width": WIDTH, "threshold": THRESHOLD}
    loss = StateDeviationLoss(networks.actor, dynamics, vae, **options).double()
    loss.log_multiplier.data.fill_(math.log(MULTIPLIER))
    multiplier = loss.log_multiplier.detach().clone().requires_grad_()

    def losses() -> dict[str, Tensor]:
        excess = restated_sdc(plain, dynamics, vae, batch).mean() - THRESHOLD
        return {
            "loss_deviation": MULTIPLIER * excess,
            "loss_multiplier": -multiplier.exp() * excess.detach(),
        }

    trained = {
        "loss_deviation actor": plain.actor,
        "loss_multiplier log_multiplier": multiplier,
    }
    out = compare(check, "SDC", loss, batch, losses, trained, 1e-10)
    assert out["multiplier"].item() == pytest.approx(MULTIPLIER)
