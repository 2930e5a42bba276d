"""TD3BCLoss against a plain restatement of its equations.

"A Minimalist Approach to Offline Reinforcement Learning" (Fujimoto and Gu 2021,
https://arxiv.org/abs/2106.06860).
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch, update_targets
from objectives.plain import Plain, compare, following, prepare
from torch import Tensor, nn

from torchrl_osr.lab.losses import TD3BCLoss

ALPHA, NOISE, CLIP, LOW, HIGH = 1.7, 0.6, 0.5, -0.9, 0.95
OPTIONS = {"policy_noise": NOISE, "noise_clip": CLIP, "low": LOW, "high": HIGH}


def smoothed(plain: Plain, batch) -> tuple[Tensor, Tensor]:
    """Return the action of TD3's target, and its lowest value."""
    noise = NOISE * torch.randn(len(batch), 2, dtype=torch.float64)
    with torch.no_grad():
        action = plain.old_actor.module(following(batch)) + noise.clip(-CLIP, CLIP)
        action = action.clip(LOW, HIGH)
        return action, plain.values(following(batch), action, plain.targets).amin(0)


@pytest.mark.parametrize("loop", [True, False])
def test_losses_and_gradients_equal_the_restatement(check, loop) -> None:
    networks, batch = Networks(), make_batch("td3-bc", 10)
    plain = Plain(networks, actor="module")

    def restated() -> dict[str, Tensor]:
        policy = plain.actor.module(batch["observation"])
        first = plain.values(batch["observation"], policy)[0]
        weight = ALPHA / first.abs().mean().detach()
        cloning = nn.functional.mse_loss(policy, batch["action"])
        _, value = smoothed(plain, batch)
        return {
            "loss_actor": cloning - weight * first.mean(),
            "loss_qvalue": plain.td_loss(batch, value),
        }

    options = OPTIONS | {"alpha": ALPHA, "deactivate_vmap": loop}
    loss = TD3BCLoss(networks.module, networks.critics, **options).double()
    update_targets(loss)
    expected = {"loss_actor actor": plain.actor, "loss_qvalue qvalue": plain.critics}
    compare(check, "TD3+BC", prepare(loss), batch, restated, expected)
