"""CQLLoss against a plain restatement of its equations, and SAC-N.

"Conservative Q-Learning" (Kumar et al. 2020, https://arxiv.org/abs/2006.04779) and its
common implementations for the options, "Uncertainty-Based Offline Reinforcement
Learning with Diversified Q-Ensemble" (An et al. 2021,
https://arxiv.org/abs/2110.01548) for SAC-N.
"""

from __future__ import annotations

import math

import pytest
import torch
from objectives.losses import Networks, call, make_batch, make_loss, update_targets
from objectives.plain import (
    ALPHA,
    BOX,
    DEFAULTS,
    LOG_PRIME,
    SOFT,
    UNIT,
    Plain,
    PlainCQL,
    compare,
    prepare,
)

from torchrl_osr import CQLLoss

LAGRANGE = {"target_action_gap": 2.0}
VARIANTS = {
    "CQL(H)": {},
    "CQL(H) on D_tot": {"actor_states": "both"},
    "CQL(H) with its options: temperature": {"temperature": 0.6},
    "CQL(H) with its options: clipped": {"clip_diff_min": 5.9},
    "CQL(H) with its options: max backup": {"max_q_backup": True},
    "CQL(H) with its options: entropy": {"deterministic_backup": False},
    "CQL(H) with its options: gap": LAGRANGE,
    "CQL(H) with its options: all": {
        "clip_diff_min": 5.9,
        "target_action_gap": -1.0,
        "max_q_backup": True,
    },
    "SAC-N": {"min_q_weight": 0.0, "deterministic_backup": False},
}
STATES = {"clean": slice(0, 1), "perturbed": slice(1, 2), "both": slice(0, 2)}


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("variant", VARIANTS)
def test_losses_and_gradients_equal_the_restatement(check, variant, number) -> None:
    bounds = UNIT if number == 1 else BOX
    networks, batch = Networks(number=number, **bounds), make_batch("osr", 10)
    options = VARIANTS[variant]
    loss = CQLLoss(networks.actor, networks.critics, **(DEFAULTS | SOFT | options))
    loss = update_targets(loss.double())
    if "target_action_gap" in options:
        loss.log_alpha_prime.data.fill_(LOG_PRIME)
    states = options.get("actor_states", "clean")
    plain = PlainCQL(networks, **options)
    both = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    compare(
        check,
        variant.partition(":")[0],
        prepare(loss),
        batch,
        lambda: plain.losses(batch, both[STATES[states]]),
        plain.networks,
    )


def test_metrics_and_priorities_are_what_they_are_called() -> None:
    networks, batch = Networks(), make_batch("cql", 10)
    loss, plain = make_loss("cql", networks, **SOFT), Plain(networks)
    out = call(prepare(loss), batch)
    assert out["alpha"].item() == pytest.approx(ALPHA)
    # -log alpha (mean log pi + target): the entropy is what the temperature sees.
    entropy = -1.5 + out["loss_alpha"] / math.log(ALPHA)
    assert out["entropy"].item() == pytest.approx(entropy.item())
    values = plain.values(batch["observation"], batch["action"]).detach()
    torch.testing.assert_close(out["pred_value"], values.mean())
    loss.make_value_estimator(gamma=0.0)
    reward = batch["next", "reward"].squeeze(-1)
    out = call(loss, batch)
    torch.testing.assert_close(out["target_value"], reward.mean())
    # The priority is the largest error of the critics.
    torch.testing.assert_close(batch["td_error"], (values - reward).abs().amax(0))
