"""OSRLoss, and the authors' released variant, against a plain restatement."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import (
    Networks,
    density,
    make_batch,
    make_loss,
    update_targets,
)
from objectives.plain import BOX, DEFAULTS, SOFT, UNIT, PlainCQL, compare, prepare
from torch import Tensor
from torch.distributions import kl_divergence

from torchrl_osr import OSRLoss

RECOVERY_WEIGHT = 0.75


def restated(networks: Networks, batch, *, released: bool, **options):
    """Return the losses as a function, and the networks that they train."""
    plain, model = (
        PlainCQL(networks, **options),
        copy.deepcopy(networks.model),
    )
    states = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    valid = ~batch["next", "done"].squeeze(-1)

    def recovery() -> Tensor:
        s = states[1:] if released else states
        with torch.no_grad():
            ours = density(model, s, batch["next", "observation"].expand_as(s))
        pair = [ours, plain.policy(s)]
        each = kl_divergence(*(pair[::-1] if released else pair)).sum(-1)
        each = each / 2 if released else each
        return RECOVERY_WEIGHT * each.mean(0)[valid].mean()

    def losses() -> dict[str, Tensor]:
        found = plain.losses(batch, states[:1] if released else states)
        if released:
            return found | {"loss_recovery": recovery()}
        return found | {"loss_actor": found["loss_actor"] + recovery()}

    return losses, plain.networks


VARIANTS = {
    "OSR": {},
    "OSR: temperature 1": {"temperature": 1.0},
    "OSR-10": {"min_q_weight": 0.0, "deterministic_backup": False},
}


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("variant", VARIANTS)
def test_losses_and_gradients_equal_the_restatement(check, variant, number) -> None:
    bounds = UNIT if number == 1 else BOX
    networks, batch = Networks(number=number, **bounds), make_batch("osr", 10)
    options = VARIANTS[variant]
    expected = restated(networks, batch, released=False, **options)
    options = DEFAULTS | SOFT | options | {"recovery_weight": RECOVERY_WEIGHT}
    loss = OSRLoss(networks.actor, networks.critics, networks.model, **options)
    loss = update_targets(loss.double())
    label = variant.partition(":")[0]
    out = compare(check, label, prepare(loss), batch, *expected)
    assert not out["recovery_kl"].requires_grad


def test_released_variant_equals_the_restatement(check) -> None:
    networks, batch = Networks(**BOX), make_batch("osr", 10)
    expected = restated(networks, batch, released=True)
    loss = make_loss("official", networks, **(DEFAULTS | SOFT))
    loss.recovery.recovery_weight = RECOVERY_WEIGHT
    compare(check, "OSR, official variant", prepare(loss), batch, *expected)
