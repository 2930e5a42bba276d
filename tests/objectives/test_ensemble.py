"""OSR-10 and SAC-N: many critics in the place of the conservative term."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn
from torch.distributions import Normal, kl_divergence

from torchrl_osr import OSRLoss


def build(networks, **kwargs) -> OSRLoss:
    loss = OSRLoss(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        min_q_weight=0.0,
        **kwargs,
    ).double()
    loss.make_value_estimator(gamma=0.9)
    # No updater: the targets stay what the critics were.
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    return loss


@pytest.mark.parametrize("num_critics", [1, 3, 10])
# Critics with ReLUs are plain MLPs, which have a path of their own.
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
def test_losses_are_sac_n_restated(
    make_networks, make_batch, check, num_critics, activation
) -> None:
    """SAC-N (An et al., 2021, equation 2) critic by critic, with the same draws."""
    networks = make_networks(num_critics=num_critics, critic_activation=activation)
    batch = make_batch(10)
    loss = build(
        networks, recovery_weight=0.0, alpha_init=0.25, deterministic_backup=False
    )
    loss.log_alpha.data.fill_(math.log(0.25))
    torch.manual_seed(5)
    out = loss(batch.clone())

    torch.manual_seed(5)
    state, following = batch["observation"], batch["next", "observation"]
    ended = batch["next", "terminated"]
    pair = batch.select("observation").clone()
    action, log_prob = networks.actor.get_dist(pair).rsample_and_log_prob()
    next_pair = pair.clone().set("observation", torch.where(ended, state, following))
    next_action, next_log_prob = networks.actor.get_dist(
        next_pair
    ).rsample_and_log_prob()

    def values(observation, action):
        return torch.stack(
            [
                critic.module(observation, action).squeeze(-1)
                for critic in networks.critics
            ]
        )

    soft_next = values(following, next_action).amin(0) - 0.25 * next_log_prob
    target = batch["next", "reward"] + 0.9 * soft_next.unsqueeze(-1) * ~ended
    td = (
        (values(state, batch["action"]) - target.detach().squeeze(-1))
        .square()
        .sum(0)
        .mean()
    )
    actor = (0.25 * log_prob - values(state, action).amin(0)).mean()
    got = [out["loss_qvalue"], out["loss_actor"]]
    check("SAC-N", got, [td, actor], tolerance=1e-9)
    names = list(out.keys())
    assert names == loss.out_keys
    assert "loss_cql" not in names


def test_osr_10_adds_the_recovery_term_alone(make_networks, make_batch, check) -> None:
    networks, batch = make_networks(num_critics=10), make_batch(10)
    batch["next", "done"][:] = False
    loss = build(networks, recovery_weight=0.75)
    out = loss(batch.clone())
    kl = []
    for state in (batch["observation"], batch["perturbed", "observation"]):
        pair = batch.clone().set("observation", state)
        pi, model = (
            networks.actor.get_dist(pair),
            networks.inverse_dynamics.get_dist(pair),
        )
        policy, model = Normal(pi.loc, pi.scale), Normal(model.loc, model.scale)
        kl.append(kl_divergence(model, policy).sum(-1))
    wanted = 0.75 * torch.stack(kl).mean()
    check("OSR-10", [out["loss_recovery"]], [wanted], tolerance=1e-9)
    assert set(out.keys()) == {
        "loss_actor", "loss_alpha", "loss_qvalue", "loss_recovery", "alpha",
        "entropy", "pred_value", "target_value", "recovery_kl",
    }  # fmt: skip


def test_every_critic_is_trained_in_one_pass(make_networks, make_batch) -> None:
    networks = make_networks(num_critics=10)
    loss = build(networks, recovery_weight=0.0)
    calls = []
    forward = loss._vmap_qvalue
    loss._vmap_qvalue = lambda *args: calls.append(args) or forward(*args)
    loss(make_batch(10))["loss_qvalue"].backward()
    # The data's action, the policy's and the target's: three passes for all ten.
    assert len(calls) == 3
    for params in loss.qvalue_network_params.values(True, True):
        assert params.shape[0] == 10
        assert params.grad.flatten(1).abs().sum(1).all()
