"""Under autocast the products are in half precision and nothing else is."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torchrl.modules import TanhNormal

from torchrl_osr import InverseDynamicsLoss, OSRLoss
from torchrl_osr.lab.losses import BCLoss
from torchrl_osr.modules import (
    critic_ensemble,
    cvae_inverse_dynamics,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

# Eight bits of mantissa; the losses are means over a batch.
RELATIVE = 2e-2


def single(batch):
    return batch.apply(lambda x: x.float() if x.is_floating_point() else x)


def losses_and_gradients(loss, batch, *, autocast: bool):
    torch.manual_seed(2)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        out = loss(batch)
    losses = {k: v for k, v in out.items() if k.startswith("loss_")}
    params = list(loss.parameters())
    return out, losses, torch.autograd.grad(sum(losses.values()), params)


@pytest.mark.losses
def test_every_output_is_float32_and_close(family, family_batch, name) -> None:
    loss, batch = family(name).float(), single(family_batch(name, 64))
    _, wanted, _ = losses_and_gradients(loss, batch.copy(), autocast=False)
    out, found, gradients = losses_and_gradients(loss, batch.copy(), autocast=True)
    for key, value in out.items():
        assert value.dtype == torch.float32, key
    for key, value in found.items():
        # 0.1: the Lagrangian's terms are small differences of gap and threshold.
        torch.testing.assert_close(value, wanted[key], rtol=0.1, atol=RELATIVE)
    for gradient in gradients:
        assert gradient.dtype == torch.float32
        assert gradient.isfinite().all()


@pytest.mark.parametrize("activation_class", [nn.ReLU, nn.ELU], ids=["plain", "other"])
def test_gradient_of_the_critics_is_close_on_both_paths(
    make_batch, activation_class
) -> None:
    loss = OSRLoss(
        tanh_gaussian_actor(3, 2, num_cells=[32]),
        critic_ensemble(3, 2, num_cells=[32, 32], activation_class=activation_class),
        tanh_gaussian_inverse_dynamics(3, 2, num_cells=[32]),
        delay_qvalue=False,
    )
    batch = single(make_batch(256))
    results = [
        losses_and_gradients(loss, batch.copy(), autocast=autocast)[2]
        for autocast in (True, False)
    ]
    half, full = (torch.cat([g.flatten() for g in each]) for each in results)
    assert (half - full).norm() < RELATIVE * full.norm()
    assert not torch.equal(half, full), "nothing was computed in half precision"


@pytest.mark.parametrize(
    "build", [tanh_gaussian_inverse_dynamics, cvae_inverse_dynamics]
)
def test_likelihood_is_that_of_float32_parameters(make_batch, build) -> None:
    loss, batch = InverseDynamicsLoss(build(3, 2)), single(make_batch(64))
    _, wanted, _ = losses_and_gradients(loss, batch, autocast=False)
    out, found, _ = losses_and_gradients(loss, batch, autocast=True)
    key = "loss_inverse_dynamics"
    assert out[key].dtype == torch.float32
    torch.testing.assert_close(found[key], wanted[key], rtol=RELATIVE, atol=RELATIVE)


def test_density_of_a_cloned_policy_is_that_of_float32_parameters(make_batch) -> None:
    actor, batch = tanh_gaussian_actor(3, 2, num_cells=[32]), single(make_batch(64))
    with torch.autocast("cpu", torch.bfloat16):
        # As accurate as its parameters: the density itself is not rounded.
        found = BCLoss(actor, reduction="none")(batch.copy())["loss_actor"]
        params = actor.get_dist_params(batch.copy())
    loc, scale = (params[name].float() for name in ("loc", "scale"))
    policy = TanhNormal(loc, scale)
    torch.testing.assert_close(found, -policy.log_prob(batch["action"]))
