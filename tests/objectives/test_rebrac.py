"""ReBRACLoss against a plain restatement of its equations.

"Revisiting the Minimalist Approach to Offline Reinforcement Learning" (Tarasov et al.
2023, https://arxiv.org/abs/2305.09836).
"""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.losses import ReBRACLoss

GAMMA, NOISE, CLIP, TARGET_SCALE = 0.875, 0.6, 0.5, 0.8
BETA_1, BETA_2, LOW, HIGH = 0.3, 0.7, -0.8, 0.7


@pytest.fixture
def make_networks(make_networks, make_deterministic_actor):
    """Return a factory of networks with a deterministic actor."""

    def make(**options):
        networks = make_networks(**options)
        networks.actor = make_deterministic_actor("module")
        return networks

    return make


@pytest.fixture
def make_batch(make_batch):
    """Return a factory of batches with a next action, NaN where there is none."""

    def make(*size: int):
        batch = make_batch(*size, twin=False)
        action = 0.9 * torch.tanh(torch.randn(*size, 2, dtype=torch.float64))
        batch["next", "action"] = action.masked_fill(batch["next", "done"], torch.nan)
        return batch

    return make


def make_loss(networks, **options) -> ReBRACLoss:
    """A loss with every number off its default and targets of their own."""
    numbers = {"actor_bc_coef": BETA_1, "critic_bc_coef": BETA_2}
    smoothing = {"policy_noise": NOISE, "noise_clip": CLIP, "low": LOW, "high": HIGH}
    loss = ReBRACLoss(
        networks.actor, networks.critics, **(numbers | smoothing | options)
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    for params in (loss.target_qvalue_network_params, loss.target_actor_network_params):
        params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    return loss


def restated(networks, batch, beta_2: float = BETA_2) -> dict[str, Tensor]:
    """The losses, one critic and one row at a time; no torchrl_osr."""
    critics, actor = [c.module for c in networks.critics], networks.actor.module
    old_critics, old_actor = copy.deepcopy((critics, actor))
    for network in (*old_critics, old_actor):
        for parameter in network.parameters():
            parameter.data.mul_(TARGET_SCALE)
    s, a, s_next = batch["observation"], batch["action"], batch["next", "observation"]
    torch.manual_seed(5)
    noise = (NOISE * torch.randn(a.shape, dtype=a.dtype)).clip(-CLIP, CLIP)
    target = []
    for row in range(len(s)):
        value = batch["next", "reward"][row]
        if not batch["next", "terminated"][row]:
            with torch.no_grad():
                action = (old_actor(s_next[row]) + noise[row]).clip(LOW, HIGH)
                after = min(q(torch.cat([s_next[row], action])) for q in old_critics)
            if not batch["next", "done"][row]:
                difference = action - batch["next", "action"][row]
                after = after - beta_2 * difference.dot(difference)
            value = value + GAMMA * after
        target.append(value)
    target = torch.stack(target)
    policy = actor(s)
    lowest = torch.min(*(q(torch.cat([s, policy], -1)) for q in critics))
    distance = nn.functional.mse_loss(policy, a, reduction="sum") / len(s)
    q_loss = (nn.functional.mse_loss(q(torch.cat([s, a], -1)), target) for q in critics)
    return {
        "loss_actor": BETA_1 * distance - (lowest / lowest.abs().mean().item()).mean(),
        "loss_qvalue": sum(q_loss),
    }


# Critics with ReLUs are plain MLPs, which have a path of their own on a CPU.
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
@pytest.mark.parametrize("beta_2", [BETA_2, 0.0])
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check_restated, activation, beta_2
) -> None:
    networks = make_networks(critic_activation=activation)
    batch, reference = make_batch(10), copy.deepcopy(networks)
    loss = make_loss(networks, critic_bc_coef=beta_2)
    torch.manual_seed(5)
    out = loss(batch if beta_2 else batch.exclude(("next", "action")))
    losses = {key: out[key] for key in ("loss_actor", "loss_qvalue")}
    expected = restated(reference, batch, beta_2)
    networks = reference.actor, reference.critics
    check_restated("ReBRAC", loss, losses, expected, *networks)


def test_rows_are_each_ones_own_and_masks_reach_all_terms(
    make_networks, make_batch
) -> None:
    networks, batch = make_networks(), make_batch(10)
    loss = make_loss(networks, reduction="none", scalar_output_mode="exclude")
    rows = loss(batch)["loss_actor"]
    s, policy = batch["observation"], networks.actor.module(batch["observation"])
    lowest = torch.min(*(q.module(s, policy) for q in networks.critics)).squeeze(-1)
    distance = (policy - batch["action"]).square().sum(-1)
    torch.testing.assert_close(rows, BETA_1 * distance - lowest / lowest.abs().mean())
    # A row that is masked out has no part in any of it.
    batch["collector", "mask"] = torch.arange(10) % 4 > 0
    masked = make_loss(networks)(batch)["loss_actor"]
    left = make_loss(networks)(batch[batch["collector", "mask"]])["loss_actor"]
    torch.testing.assert_close(masked, left)


@pytest.mark.parametrize("option", ["actor_bc_coef", "critic_bc_coef", "policy_noise"])
def test_negative_weights_are_refused(make_networks, option) -> None:
    with pytest.raises(ValueError, match=f"{option} must be at least 0, got -1"):
        make_loss(make_networks(), **{option: -1.0})
