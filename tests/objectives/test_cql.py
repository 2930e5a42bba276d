"""CQLLoss, OSRLoss and the authors' released variant against plain restatements.

"Conservative Q-Learning" (Kumar et al. 2020, https://arxiv.org/abs/2006.04779) and its
common implementations for the options, "Uncertainty-Based Offline Reinforcement
Learning with Diversified Q-Ensemble" (An et al. 2021,
https://arxiv.org/abs/2110.01548) for SAC-N.
"""

from __future__ import annotations

import copy
import math

import pytest
import torch
from objectives.losses import Networks, call, density, make_batch, make_loss
from objectives.plain import ALPHA, BOX, DEFAULTS, UNIT, PlainCQL, compare, prepare
from torch import Tensor
from torch.distributions import kl_divergence

RECOVERY_WEIGHT = 0.75
ALL = {"clip_diff_min": 5.9, "target_action_gap": -1.0, "max_q_backup": True}
ENSEMBLE = {"min_q_weight": 0.0, "deterministic_backup": False}
VARIANTS = {
    "CQL(H)": {},
    "CQL(H) on D_tot": {"actor_states": "both"},
    "CQL(H) with its options: temperature": {"temperature": 0.6},
    "CQL(H) with its options: clipped": {"clip_diff_min": 5.9},
    "CQL(H) with its options: max backup": {"max_q_backup": True},
    "CQL(H) with its options: soft max backup": ENSEMBLE | {"max_q_backup": True},
    "CQL(H) with its options: entropy": {"deterministic_backup": False},
    "CQL(H) with its options: gap": {"target_action_gap": 2.0},
    "CQL(H) with its options: all": ALL,
    "SAC-N": ENSEMBLE,
    "OSR": {},
    "OSR: temperature 1": {"temperature": 1.0},
    "OSR: values of clean states": {"actor_states": "clean"},
    "OSR-10": ENSEMBLE,
}


def recovery(plain: PlainCQL, model, batch, *, released: bool = False) -> Tensor:
    """Return the weighted recovery term, over rows with a next state."""
    pushed, done = batch["perturbed", "observation"], batch["next", "done"].squeeze(-1)
    s = torch.stack([pushed] if released else [batch["observation"], pushed])
    with torch.no_grad():
        wanted = density(model, s, batch["next", "observation"].expand_as(s))
    pair = [wanted, plain.policy(s)]
    each = kl_divergence(*(pair[::-1] if released else pair)).sum(-1)
    each = each / 2 if released else each
    return RECOVERY_WEIGHT * each.mean(0)[~done].mean()


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("variant", VARIANTS)
def test_losses_and_gradients_equal_the_restatement(check, variant, number) -> None:
    bounds = UNIT if number == 1 else BOX
    networks, batch = Networks(number=number, **bounds), make_batch("osr", 10)
    options, recovers = VARIANTS[variant], variant.startswith("OSR")
    plain, model = PlainCQL(networks, **options), copy.deepcopy(networks.model)
    states = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    if options.get("actor_states", "both" if recovers else "clean") == "clean":
        states = states[:1]

    def restated() -> dict[str, Tensor]:
        found = plain.losses(batch, states)
        if recovers:
            found["loss_actor"] = found["loss_actor"] + recovery(plain, model, batch)
        return found

    weight = {"recovery_weight": RECOVERY_WEIGHT} if recovers else {}
    given = DEFAULTS | options | weight
    loss = make_loss("osr" if recovers else "cql", networks, **given)
    compare(check, variant, prepare(loss), batch, restated, plain.networks)


def test_released_variant_equals_the_restatement(check) -> None:
    networks, batch = Networks(**BOX), make_batch("osr", 10)
    plain, model = PlainCQL(networks), copy.deepcopy(networks.model)
    loss = make_loss("official", networks, **DEFAULTS)
    loss.recovery.recovery_weight = RECOVERY_WEIGHT

    def restated() -> dict[str, Tensor]:
        term = recovery(plain, model, batch, released=True)
        clean = batch["observation"].unsqueeze(0)
        return plain.losses(batch, clean) | {"loss_recovery": term}

    compare(check, "as released", prepare(loss), batch, restated, plain.networks)


def test_metrics_and_priorities_are_what_they_are_called() -> None:
    networks, batch = Networks(), make_batch("cql", 10)
    loss, plain = make_loss("cql", networks, **DEFAULTS), PlainCQL(networks)
    assert loss.alpha.item() == pytest.approx(ALPHA), "alpha_init"
    assert loss.value_estimator.gamma.item() == pytest.approx(0.99)
    out = call(prepare(loss), batch)
    assert out["alpha"].item() == pytest.approx(ALPHA)
    # -log alpha (mean log pi + target): the entropy is what the temperature sees.
    entropy = -1.5 + out["loss_alpha"] / math.log(ALPHA)
    assert out["entropy"].item() == pytest.approx(entropy.item())
    values = plain.values(batch["observation"], batch["action"]).detach()
    torch.testing.assert_close(out["pred_value"], values.mean())
    loss.make_value_estimator(gamma=0.0)
    loss.loss_function = "l1"
    reward = batch["next", "reward"].squeeze(-1)
    out = call(loss, batch)
    torch.testing.assert_close(out["target_value"], reward.mean())
    # The priority is the largest error of the critics.
    error = (values - reward).abs()
    torch.testing.assert_close(batch["td_error"], error.amax(0))
    torch.testing.assert_close(out["loss_qvalue"].detach(), error.mean(1).sum())
