"""BCLoss against torch.distributions."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import Networks, make_batch
from objectives.plain import BOX, Plain

from torchrl_osr.lab.losses import BCLoss


@pytest.mark.parametrize("kind", ["actor", "delta", "module"])
def test_value_and_gradients_equal_the_restatement(check, kind) -> None:
    networks, batch = Networks(**BOX), make_batch("bc", 10)
    actor, plain = copy.deepcopy(getattr(networks, kind)), Plain(networks, kind)
    s, a = batch["observation"], batch["action"]
    if kind == "actor":
        expected = -plain.log_prob(plain.policy(s), a).mean()
    else:
        # TorchRL moves a TanhDelta's parameter by the center.
        x = plain.actor[0].module(s) + plain.center if kind == "delta" else None
        x = plain.actor.module[0](s) if x is None else x
        action = plain.center + plain.half * torch.tanh(x)
        expected = (action - a).square().sum(-1).mean()
    slopes = torch.autograd.grad(expected, [*plain.actor.parameters()])
    loss = BCLoss(actor).double()
    value = loss(batch)["loss_actor"]
    value.backward()
    found = [value.detach(), *(each.grad for each in loss.parameters())]
    wanted = [expected.detach(), *slopes]
    check("Behaviour cloning", found, wanted, tolerance=1e-10)
