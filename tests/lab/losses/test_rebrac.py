"""ReBRACLoss against a plain restatement of its equations, row by row.

"Revisiting the Minimalist Approach to Offline Reinforcement Learning" (Tarasov et al.
2023, https://arxiv.org/abs/2305.09836).
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch, update_targets
from objectives.plain import Plain, compare, prepare
from torch import Tensor, nn

from torchrl_osr.lab.losses import ReBRACLoss

NOISE, CLIP, BETA_1, BETA_2, LOW, HIGH = 0.6, 0.5, 0.3, 0.7, -0.9, 0.95
OPTIONS = {"policy_noise": NOISE, "noise_clip": CLIP, "low": LOW, "high": HIGH}


@pytest.mark.parametrize("beta_2", [BETA_2, 0.0])
def test_losses_and_gradients_equal_the_restatement(check, beta_2) -> None:
    networks, batch = Networks(), make_batch("rebrac", 10)
    done = batch["next", "done"]
    # What follows an end is never read.
    batch["next", "action"] = batch["next", "action"].masked_fill(done, torch.nan)
    plain = Plain(networks, actor="module")

    def bootstrap(row, noise: Tensor) -> Tensor:
        state = row["next", "observation"]
        action = (plain.old_actor.module(state) + noise).clip(LOW, HIGH)
        value = plain.values(state, action, plain.targets).min()
        if not row["next", "done"]:
            difference = action - row["next", "action"]
            value = value - beta_2 * difference.dot(difference)
        return value

    def restated() -> dict[str, Tensor]:
        s, a = batch["observation"], batch["action"]
        noise = (NOISE * torch.randn(a.shape, dtype=a.dtype)).clip(-CLIP, CLIP)
        policy = plain.actor.module(s)
        lowest = plain.values(s, policy).amin(0)
        distance = nn.functional.mse_loss(policy, a, reduction="sum") / len(s)
        value = torch.stack(
            [bootstrap(*each) for each in zip(batch, noise, strict=True)]
        )
        sought = (lowest / lowest.abs().mean().item()).mean()
        return {
            "loss_actor": BETA_1 * distance - sought,
            "loss_qvalue": plain.td_loss(batch, value),
        }

    options = OPTIONS | {"actor_bc_coef": BETA_1, "critic_bc_coef": beta_2}
    loss = ReBRACLoss(networks.module, networks.critics, **options).double()
    update_targets(loss)
    expected = {"loss_actor actor": plain.actor, "loss_qvalue qvalue": plain.critics}
    read = batch if beta_2 else batch.exclude(("next", "action"))
    compare(check, "ReBRAC", prepare(loss), read, restated, expected)
