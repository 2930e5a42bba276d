"""TD3BCLoss and ReBRACLoss against plain restatements of their equations.

"A Minimalist Approach to Offline Reinforcement Learning" (Fujimoto and Gu 2021,
https://arxiv.org/abs/2106.06860) and "Revisiting the Minimalist Approach to Offline
Reinforcement Learning" (Tarasov et al. 2023, https://arxiv.org/abs/2305.09836).
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, call, make_batch, make_loss, update_targets
from objectives.plain import Plain, compare, following, prepare
from torch import Tensor, nn

from torchrl_osr.lab.losses import ReBRACLoss, TD3BCLoss

ALPHA, BETA_1, BETA_2 = 1.7, 0.3, 0.7
NOISE, CLIP, LOW, HIGH = 0.6, 0.5, -0.9, 0.95
OPTIONS = {"policy_noise": NOISE, "noise_clip": CLIP, "low": LOW, "high": HIGH}


def smoothed(plain: Plain, batch) -> tuple[Tensor, Tensor]:
    """Return the action of TD3's target, and its lowest value."""
    noise = NOISE * torch.randn(len(batch), 2, dtype=torch.float64)
    with torch.no_grad():
        action = plain.old_actor.module(following(batch)) + noise.clip(-CLIP, CLIP)
        action = action.clip(LOW, HIGH)
        return action, plain.values(following(batch), action, plain.targets).amin(0)


def td3_bc(plain: Plain, batch) -> dict[str, Tensor]:
    policy = plain.actor.module(batch["observation"])
    first = plain.values(batch["observation"], policy)[0]
    weight = ALPHA / first.abs().mean().detach()
    cloning = nn.functional.mse_loss(policy, batch["action"])
    _, value = smoothed(plain, batch)
    return {
        "loss_actor": cloning - weight * first.mean(),
        "loss_qvalue": plain.td_loss(batch, value),
    }


def rebrac(plain: Plain, batch, beta_2: float) -> dict[str, Tensor]:
    s, a = batch["observation"], batch["action"]
    policy = plain.actor.module(s)
    lowest = plain.values(s, policy).amin(0)
    distance = nn.functional.mse_loss(policy, a, reduction="sum") / len(s)
    sought = (lowest / lowest.abs().mean().item()).mean()
    action, value = smoothed(plain, batch)
    for row in (~batch["next", "done"].squeeze(-1)).nonzero().flatten():
        difference = action[row] - batch["next", "action"][row]
        value[row] -= beta_2 * difference.dot(difference)
    return {
        "loss_actor": BETA_1 * distance - sought,
        "loss_qvalue": plain.td_loss(batch, value),
    }


def compared(check, label: str, loss_class, batch, restated, **options) -> None:
    networks = Networks()
    plain = Plain(networks, actor="module")
    parts = networks.module, networks.critics
    loss = update_targets(loss_class(*parts, **OPTIONS, **options).double())
    expected = {"loss_actor actor": plain.actor, "loss_qvalue qvalue": plain.critics}
    compare(check, label, prepare(loss), batch, lambda: restated(plain), expected)


def test_td3_bc_equals_the_restatement(check) -> None:
    batch = make_batch("td3-bc", 10)
    restated = lambda plain: td3_bc(plain, batch)  # noqa: E731
    compared(check, "TD3+BC", TD3BCLoss, batch, restated, alpha=ALPHA)


@pytest.mark.parametrize("beta_2", [BETA_2, 0.0])
def test_rebrac_equals_the_restatement(check, beta_2) -> None:
    batch = make_batch("rebrac", 10)
    # What follows an end is never read.
    batch["next", "action"][batch["next", "done"].squeeze(-1)] = torch.nan
    options = {"actor_bc_coef": BETA_1, "critic_bc_coef": beta_2}
    restated = lambda plain: rebrac(plain, batch, beta_2)  # noqa: E731
    read = batch if beta_2 else batch.exclude(("next", "action"))
    compared(check, "ReBRAC", ReBRACLoss, read, restated, **options)


def test_smoothed_actions_stay_within_the_bounds_of_each_dimension() -> None:
    networks, batch = Networks(low=-2.0, high=2.0), make_batch("td3-bc", 200)
    options = {"low": [-2.0, -0.5], "high": [2.0, 0.25], "policy_noise": 2.0}
    loss = TD3BCLoss(networks.module, networks.critics, noise_clip=9.0, **options)
    update_targets(loss.double())
    action, _ = loss.smoothed(loss.unpack(batch))
    assert action.amax(0).tolist() == [2.0, 0.25]
    assert action.amin(0).tolist() == [-2.0, -0.5]
    delta = Networks(high=torch.tensor([1.0, 3.0]))
    assert TD3BCLoss(delta.delta, delta.critics).action_high.tolist() == [1, 3]


def test_magnitude_of_no_values_is_one() -> None:
    loss, batch = make_loss("td3-bc"), make_batch("td3-bc", 4)
    assert loss.magnitude(loss.unpack(batch), torch.zeros(4)) == 1
    batch["collector", "mask"] = torch.tensor([True, False, False, True])
    values = torch.tensor([1.0, 9.0, 9.0, -3.0])
    assert loss.magnitude(loss.unpack(batch), values) == 2
    assert call(loss, batch)["loss_actor"].isfinite()
