"""SCASLoss, and our reading of SDC, against plain restatements, row by row.

"Offline Reinforcement Learning with OOD State Correction and OOD Action Suppression"
(Mao et al. 2024, https://arxiv.org/abs/2410.19400).
"""

from __future__ import annotations

import math

import pytest
import torch
from objectives.losses import Networks, make_batch, update_targets
from objectives.plain import Plain, compare, prepare
from torch import Tensor
from uneven_dynamics import plain_gaussian, uneven_dynamics

from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.losses import SCASLoss, StateDeviationLoss

NOISE, CLIP, LOW, HIGH, SHARE, LARGEST = 0.6, 0.5, -0.9, 0.95, 0.3, 1.1
OPTIONS = {"policy_noise": NOISE, "noise_clip": CLIP, "low": LOW, "high": HIGH}
OPTIONS |= {"correction_weight": SHARE, "largest_weight": LARGEST}
VERSIONS = {
    "released": ("clean", 2.0),
    "printed": ("perturbed", 2.0),
    "without weights": ("clean", 0.0),
}


def next_state(model: DynamicsEnsemble, state: Tensor, action: Tensor) -> Tensor:
    """Return the elites' mean, network by network."""
    mean = sum(plain_gaussian(model, number, state, action)[0] for number in (0, 2)) / 2
    return state + (mean * model.target_scale + model.target_loc)[:3]


def restated_scas(plain: Plain, model, batch, version: str) -> dict[str, Tensor]:
    (correction, temperature), actor = VERSIONS[version], plain.actor.module
    noise = torch.randn(len(batch), 2, dtype=torch.float64)
    noise = (NOISE * noise).clip(-CLIP, CLIP)
    qvalue, error, bootstrap = [], [], []
    for row, drawn in zip(batch, noise, strict=True):
        s, after = row["observation"], row["next", "observation"]
        action = (plain.old_actor.module(after) + drawn).clip(LOW, HIGH)
        bootstrap.append(plain.values(after, action, plain.targets).min())
        values = plain.values(s, actor(s))
        qvalue.append(values.min())
        if row["next", "done"]:
            continue
        gain = plain.values(after, actor(after)).mean() - values.mean()
        weight = min(torch.exp(temperature * gain).item(), LARGEST)
        perturbed = row["perturbed", "observation"]
        acts_at = perturbed if correction == "perturbed" else s
        reached = next_state(model, perturbed, actor(acts_at))
        error.append(weight * (reached - after).square().sum() / 3)
    qvalue = torch.stack(qvalue)
    sought = -(qvalue / qvalue.abs().mean().detach()).mean()
    return {
        "loss_actor": (1 - SHARE) * sought + SHARE * torch.stack(error).mean(),
        "loss_qvalue": plain.td_loss(batch, torch.stack(bootstrap)),
    }


@pytest.mark.parametrize("version", VERSIONS)
def test_scas_equals_the_restatement(check, version) -> None:
    networks, batch = Networks(number=3), make_batch("scas", 10)
    plain, (action, temperature) = Plain(networks, actor="module"), VERSIONS[version]
    options = OPTIONS | {"correction_action": action, "gain_temperature": temperature}
    model = uneven_dynamics()
    loss = SCASLoss(networks.module, networks.critics, model, **options).double()
    update_targets(loss)
    networks = {"loss_actor actor": plain.actor, "loss_qvalue qvalue": plain.critics}
    expected = lambda: restated_scas(plain, model, batch, version)  # noqa: E731
    compare(check, "SCAS", prepare(loss), batch, expected, networks, 1e-10)


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
