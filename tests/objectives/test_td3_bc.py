"""TD3BCLoss against a plain restatement of its equations.

"A Minimalist Approach to Offline Reinforcement Learning" (Fujimoto and Gu 2021,
https://arxiv.org/abs/2106.06860).
"""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.losses import TD3BCLoss
from torchrl_osr.modules import critic_ensemble, deterministic_actor

GAMMA, ALPHA, NOISE, CLIP, TARGET_SCALE = 0.875, 1.7, 0.6, 0.5, 0.8
LOW, HIGH = -0.8, 0.7


@pytest.fixture
def make_networks(make_networks, make_deterministic_actor):
    """Return a factory of networks with a deterministic actor."""

    def make(**options):
        networks = make_networks(**options)
        networks.actor = make_deterministic_actor("module")
        return networks

    return make


def make_loss(networks, **options) -> TD3BCLoss:
    """A loss with every number off its default and targets of their own."""
    numbers = {"alpha": ALPHA, "policy_noise": NOISE, "noise_clip": CLIP}
    bounds = {"low": LOW, "high": HIGH}
    loss = TD3BCLoss(
        networks.actor, networks.critics, **(numbers | bounds | options)
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    for params in (loss.target_qvalue_network_params, loss.target_actor_network_params):
        params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    return loss


def restated(networks, batch) -> dict[str, Tensor]:
    """The losses, one critic at a time; no torchrl_osr."""
    critics, actor = [c.module for c in networks.critics], networks.actor.module
    old_critics, old_actor = copy.deepcopy((critics, actor))
    for network in (*old_critics, old_actor):
        for parameter in network.parameters():
            parameter.data.mul_(TARGET_SCALE)
    s, a = batch["observation"], batch["action"]
    ended = batch["next", "terminated"]
    s_next = torch.where(ended, s, batch["next", "observation"])
    torch.manual_seed(5)
    noise = (NOISE * torch.randn(a.shape, dtype=a.dtype)).clip(-CLIP, CLIP)
    with torch.no_grad():
        next_action = (old_actor(s_next) + noise).clip(LOW, HIGH)
        value = torch.min(*(q(s_next, next_action) for q in old_critics))
        target = batch["next", "reward"] + GAMMA * (1 - ended.double()) * value
    policy = actor(s)
    first = critics[0](s, policy)
    weight = ALPHA / first.abs().mean().detach()
    return {
        "loss_actor": -weight * first.mean() + nn.functional.mse_loss(policy, a),
        "loss_qvalue": sum((q(s, a) - target).square().mean() for q in critics),
    }


# Critics with ReLUs are plain MLPs, which have a path of their own on a CPU.
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
@pytest.mark.parametrize("deactivate_vmap", [True, False])
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check_restated, activation, deactivate_vmap
) -> None:
    networks = make_networks(critic_activation=activation)
    batch, reference = make_batch(10), copy.deepcopy(networks)
    loss = make_loss(networks, deactivate_vmap=deactivate_vmap)
    torch.manual_seed(5)
    out = loss(batch)
    losses = {key: out[key] for key in ("loss_actor", "loss_qvalue")}
    expected = restated(reference, batch)
    networks = reference.actor, reference.critics
    check_restated("TD3+BC", loss, losses, expected, *networks)


def test_rows_are_each_ones_own_and_masks_reach_the_cloning_term(
    make_networks, make_batch
) -> None:
    networks, batch = make_networks(), make_batch(10)
    loss = make_loss(networks, reduction="none", scalar_output_mode="exclude")
    rows = loss(batch)["loss_actor"]
    policy = networks.actor.module(batch["observation"])
    first = networks.critics[0].module(batch["observation"], policy).squeeze(-1)
    cloning = (policy - batch["action"]).square().mean(-1)
    expected = cloning - ALPHA / first.abs().mean() * first
    torch.testing.assert_close(rows, expected)
    # A row that is masked out has no part in any of it.
    batch["collector", "mask"] = torch.arange(10) % 4 > 0
    masked = make_loss(networks)(batch)["loss_actor"]
    left = make_loss(networks)(batch[batch["collector", "mask"]])["loss_actor"]
    torch.testing.assert_close(masked, left)


def test_metrics_say_what_they_are_called(make_networks, make_batch) -> None:
    networks, batch = make_networks(), make_batch(10)
    loss = make_loss(networks, alpha=0.0)
    out = loss(batch)
    # Without values the policy's loss is the cloning error.
    torch.testing.assert_close(out["cloning_error"], out["loss_actor"].detach())
    values = [q.module(batch["observation"], batch["action"]) for q in networks.critics]
    torch.testing.assert_close(out["pred_value"], torch.stack(values).mean().detach())
    loss.make_value_estimator(gamma=0.0)
    loss(batch)
    errors = torch.stack(values) - batch["next", "reward"]
    wanted = errors.abs().amax(0).squeeze(-1).detach()
    torch.testing.assert_close(batch["td_error"], wanted)


def test_bounds_are_those_of_the_actor(make_networks) -> None:
    actor, critics = deterministic_actor(3, 2, high=[1.0, 3.0]), critic_ensemble(3, 2)
    with pytest.raises(ValueError, match=r"high=1.0, but its actor high=\[1.0, 3.0\]"):
        TD3BCLoss(actor, critics)
