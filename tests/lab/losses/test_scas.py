"""SCASLoss against a plain restatement of its equations, row by row.

"Offline Reinforcement Learning with OOD State Correction and OOD Action Suppression"
(Mao et al. 2024, https://arxiv.org/abs/2410.19400).
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch, update_targets
from objectives.plain import Plain, compare, prepare
from torch import Tensor
from uneven_dynamics import plain_gaussian, uneven_dynamics

from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.losses import SCASLoss

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


def restated(plain: Plain, model, batch, version: str) -> dict[str, Tensor]:
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
def test_losses_and_gradients_equal_the_restatement(check, version) -> None:
    networks, batch = Networks(number=3), make_batch("scas", 10)
    plain, (action, temperature) = Plain(networks, actor="module"), VERSIONS[version]
    options = OPTIONS | {"correction_action": action, "gain_temperature": temperature}
    model = uneven_dynamics()
    loss = SCASLoss(networks.module, networks.critics, model, **options).double()
    update_targets(loss)
    networks = {"loss_actor actor": plain.actor, "loss_qvalue qvalue": plain.critics}
    expected = lambda: restated(plain, model, batch, version)  # noqa: E731
    compare(check, "SCAS", prepare(loss), batch, expected, networks, 1e-10)
