"""Where TorchRL 0.14.1 is not CQL(H). A failure says that TorchRL has mended it."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.objectives import CQLLoss, SoftUpdate

from torchrl_osr import OSRLoss

NUM_RANDOM = 10
# With zero values a log-sum-exp of n importance weights tends to log(n |A|), because
# each weight 1/p has the mean |A| = 4, the area of [-1, 1]^2. Two critics. From below,
# by Jensen's inequality.
ALL_ACTIONS = 2 * math.log(3 * NUM_RANDOM * 4)  # all 3K actions of a state: CQL(H)
THREE_ACTIONS = 2 * math.log(3 * 4)  # one action of each kind at a time


def losses(networks, batch) -> dict[str, float]:
    """loss_cql of both libraries, weight 1, seeds equal."""
    target_entropy = -2.0
    ours = OSRLoss(
        networks.actor,
        networks.critics,
        recovery_weight=0.0,
        min_q_weight=1.0,
        num_random=NUM_RANDOM,
        target_entropy=target_entropy,
    ).double()
    theirs = CQLLoss(
        networks.actor,
        networks.critics,
        loss_function="l2",
        min_q_weight=1.0,
        num_random=NUM_RANDOM,
        target_entropy=target_entropy,
    ).double()
    out = {}
    for name, loss in {"ours": ours, "torchrl": theirs}.items():
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(1)
        out[name] = loss(batch.clone())["loss_cql"].item()
    return out


def state_only_critics(networks, weight: float):
    """Critics whose value is ``weight`` times the first observation, any action."""
    for critic in networks.critics:
        first, _, last = critic.module
        for parameter in critic.parameters():
            parameter.data.zero_()
        first.weight.data[0, 0] = 1.0
        last.weight.data[0, 0] = weight
    return networks


# TorchRL is wrong: Kumar et al. 2020, appendix F, and the authors' released code take
# one log-sum-exp over all the actions of a state.
def test_cql_loss_of_torchrl_sums_three_actions_instead_of_all(
    make_networks, make_batch
) -> None:
    networks = state_only_critics(make_networks(), 0.0)
    out = losses(networks, make_batch(256))
    assert ALL_ACTIONS - 0.3 < out["ours"] < ALL_ACTIONS + 0.1
    assert THREE_ACTIONS - 0.8 < out["torchrl"] < THREE_ACTIONS + 0.1


# TorchRL is wrong: both terms of the gap belong to the same state, so that a value
# which ignores the action cancels. It scores the actions of pi(s') at s'.
def test_cql_loss_of_torchrl_scores_next_actions_at_the_next_state(
    make_networks, make_batch
) -> None:
    flat, steep = (
        losses(state_only_critics(make_networks(), weight), make_batch(256))
        for weight in (0.0, 30.0)
    )
    assert steep["ours"] == pytest.approx(flat["ours"], abs=1e-9)
    assert abs(steep["torchrl"] - flat["torchrl"]) > 1.0


# TorchRL is wrong: the multiplier is to rise while the critics lower the gap. Its
# multiplier's loss is not detached from the critics, and with one backward over the sum
# of the losses, as in its own example, it raises the gap.
def test_cql_loss_of_torchrl_lets_the_multiplier_train_the_critics(
    make_networks, make_batch
) -> None:
    gradients = {}
    for name, loss_class in {"ours": OSRLoss, "torchrl": CQLLoss}.items():
        networks = make_networks()
        loss = loss_class(
            networks.actor,
            networks.critics,
            min_q_weight=1.0,
            with_lagrange=True,
            target_entropy=-2.0,
            **({"recovery_weight": 0.0} if name == "ours" else {}),
        ).double()
        SoftUpdate(loss, tau=0.1)
        out = loss(make_batch(64))
        critics = list(loss.qvalue_network_params.parameters())
        gradients[name] = [
            torch.autograd.grad(out[key], critics, retain_graph=True, allow_unused=True)
            for key in ("loss_cql", "loss_alpha_prime")
        ]
    assert all(gradient is None for gradient in gradients["ours"][1])
    conservative, multiplier = (
        torch.cat([gradient.flatten() for gradient in group])
        for group in gradients["torchrl"]
    )
    cosine = torch.cosine_similarity(conservative, multiplier, dim=0)
    assert cosine.item() == pytest.approx(-1.0, abs=1e-6)
