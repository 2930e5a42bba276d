"""SDCLoss, our reading of State Deviation Correction, and its equations written out.

CQL(H) is OSRLoss's, which has tests of its own; what is added draws after it.
"""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from uneven_dynamics import uneven_dynamics

from torchrl_osr import OSRLoss
from torchrl_osr.lab.dynamics import ConditionalVAE, DynamicsEnsemble
from torchrl_osr.lab.losses import SDCLoss

SAMPLES, WIDTH, THRESHOLD, MULTIPLIER = 3, 0.7, 0.02, 1.7
CQL = {"recovery_weight": 0.0, "actor_states": "clean", "num_random": 3}


def make_models() -> tuple[DynamicsEnsemble, ConditionalVAE]:
    dynamics = uneven_dynamics()
    keys = {"condition_key": "observation", "target_key": ("next", "observation")}
    vae = ConditionalVAE(3, 3, change=True, num_cells=[5], latent_dim=2, **keys)
    for each in vae.parameters():
        nn.init.normal_(each, std=0.5)
    vae.target_scale.uniform_(0.5, 2)
    vae.target_loc.normal_()
    return dynamics, vae.double()


def make_loss(networks, **options) -> SDCLoss:
    numbers = {"num_samples": SAMPLES, "kernel_width": WIDTH, "threshold": THRESHOLD}
    numbers |= {"num_random": 3}
    loss = SDCLoss(
        networks.actor, networks.critics, *make_models(), **(numbers | options)
    ).double()
    loss.log_multiplier.data.fill_(math.log(MULTIPLIER))
    SoftUpdate(loss, tau=0.1)
    return loss


def kernel(first: Tensor, second: Tensor) -> Tensor:
    return torch.exp(-((first - second) ** 2).sum() / (2 * WIDTH**2 * 3))


def restated(actor: nn.Module, dynamics, vae, batch) -> Tensor:
    """The squared discrepancies, row by row and pair by pair."""
    rows, shape = len(batch), (SAMPLES, 1, len(batch), 2)
    zeros = torch.zeros(shape, dtype=torch.float64)
    action_noise = torch.normal(zeros, torch.ones_like(zeros))[:, 0]
    drawn = torch.randint(2, (SAMPLES, rows))
    model_noise = torch.randn(SAMPLES, rows, 4, dtype=torch.float64)
    latent = torch.randn(SAMPLES, rows, 2, dtype=torch.float64)
    low, high = dynamics.lowest_log_variance, dynamics.highest_log_variance
    found = []
    for row in range(rows):
        state = batch["observation"][row]
        perturbed = batch["perturbed", "observation"][row]
        param = actor[0][0](perturbed)
        loc, scale = actor[0][1](param)
        reached, aimed = [], []
        for i in range(SAMPLES):
            action = torch.tanh(loc + scale * action_noise[i, row])
            number = (0, 2)[drawn[i, row]]
            first, last = dynamics.layers
            hidden = torch.cat([perturbed, action]) - dynamics.input_loc
            hidden = first.weight[number].T @ hidden + first.bias[number, 0]
            hidden = hidden * torch.sigmoid(hidden)
            out = last.weight[number].T @ hidden + last.bias[number, 0]
            free = high - torch.log(1 + torch.exp(high - out[4:]))
            variance = torch.exp(low + torch.log(1 + torch.exp(free - low)))
            sample = out[:4] + variance.sqrt() * model_noise[i, row]
            sample = sample * dynamics.target_scale
            reached.append(perturbed + sample[:3])
            first, last = vae.decoder[0], vae.decoder[2]
            hidden = first.weight @ torch.cat([state, latent[i, row]]) + first.bias
            out = last.weight @ hidden.clamp(min=0) + last.bias
            aimed.append(state + vae.target_loc + vae.target_scale * out.detach())
        value = 0.0
        for i in range(SAMPLES):
            for j in range(SAMPLES):
                value = value + kernel(reached[i], reached[j])
                value = value + kernel(aimed[i], aimed[j])
                value = value - 2 * kernel(reached[i], aimed[j])
        found.append(value / SAMPLES**2)
    return torch.stack(found)


def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check
) -> None:
    batch, networks = make_batch(10), make_networks(num_critics=2)
    plain = copy.deepcopy(networks)
    loss = make_loss(networks)
    cql = OSRLoss(plain.actor, plain.critics, **CQL).double()
    SoftUpdate(cql, tau=0.1)
    models = make_models()
    torch.manual_seed(5)
    out = loss(batch)
    torch.manual_seed(5)
    base = cql(batch.exclude("perturbed"))
    deviation = restated(plain.actor, *models, batch)
    assert all(torch.equal(out[key], value) for key, value in base.items())
    actor = list(networks.actor.parameters())
    wanted = MULTIPLIER * (deviation.mean() - THRESHOLD)
    got = torch.autograd.grad(out["loss_deviation"], actor, retain_graph=True)
    expected = torch.autograd.grad(wanted, list(plain.actor.parameters()))
    multiplier = torch.autograd.grad(out["loss_multiplier"], loss.log_multiplier)
    check(
        "SDC",
        [out["loss_deviation"].detach(), *got, *multiplier, out["deviation"]],
        [wanted.detach(), *expected, -wanted.detach(), deviation.mean().detach()],
        tolerance=1e-10,
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_samples": 0}, "num_samples must be at least 1"),
        ({"kernel_width": 0.0}, "kernel_width must be above 0"),
        ({"threshold": -1.0}, "threshold must be at least 0"),
        ({"recovery_weight": 0.5}, "needs an inverse_dynamics_network"),
    ],
)
def test_options_are_checked(make_networks, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(make_networks(), **options)
