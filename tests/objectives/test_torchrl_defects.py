"""Where TorchRL 0.14.1 is wrong. A failure says that TorchRL has mended it."""

from __future__ import annotations

import math

import pytest
import torch
import torchrl.objectives
from torchrl.data.postprocs import MultiStep
from torchrl.objectives import CQLLoss, SACLoss, SoftUpdate

from torchrl_osr import OSRLoss
from torchrl_osr.lab.losses import TD3BCLoss

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


# TorchRL is wrong: a mean over weights that are all 0 is 0 / 0. A buffer may hand out
# such a batch where priorities are 0.
def test_weighted_mean_of_torchrl_over_no_weight_is_nan(
    make_networks, make_batch
) -> None:
    networks, batch = make_networks(), make_batch(10)
    theirs = SACLoss(networks.actor, networks.critics, target_entropy=-2.0).double()
    ours = OSRLoss(networks.actor, networks.critics, recovery_weight=0.0).double()
    batch["priority_weight"] = torch.zeros(10, dtype=torch.float64)
    for loss in (ours, theirs):
        SoftUpdate(loss, tau=0.1)
    assert theirs(batch.clone())["loss_qvalue"].isnan()
    assert ours(batch)["loss_qvalue"] == 0


# TorchRL is wrong: the cloning term is a mean over the batch that is added to each
# row, so that a row which is masked out still pulls the policy.
def test_cloning_term_of_torchrl_ignores_masks(
    make_networks, make_deterministic_actor, make_batch
) -> None:
    networks, batch = make_networks(), make_batch(10)
    batch["collector", "mask"] = (torch.arange(10) < 5).unsqueeze(-1)
    spoiled = batch.clone()
    spoiled["action"][5:] = 0.99
    seen = {}
    for loss_class in (TD3BCLoss, torchrl.objectives.TD3BCLoss):
        bounds = {} if loss_class is TD3BCLoss else {"bounds": (-1.0, 1.0)}
        actor = make_deterministic_actor("actor")
        loss = loss_class(actor, networks.critics, **bounds).double()
        SoftUpdate(loss, tau=0.1)
        values = [loss(each.clone())["loss_actor"] for each in (batch, spoiled)]
        seen[loss_class] = torch.equal(*values)
    assert seen == {TD3BCLoss: True, torchrl.objectives.TD3BCLoss: False}


# TorchRL is wrong: the next state moves to where the n steps end, the flags do not. A
# return that reaches the terminal state is bootstrapped from it, by every loss.
def test_multi_step_of_torchrl_leaves_the_flags_of_the_first_step(make_batch) -> None:
    batch = make_batch(1, 3)
    batch["next", "terminated"][:] = False
    batch["next", "terminated"][:, 2] = True
    batch["next", "done"] = batch["next", "terminated"].clone()
    shifted = MultiStep(0.9, 3)(batch.clone())
    assert shifted["steps_to_next_obs"].tolist() == [[3, 2, 1]]
    last = batch["next", "observation"][:, 2:].expand(1, 3, 3)
    assert torch.equal(shifted["next", "observation"], last)
    assert shifted["next", "terminated"].flatten().tolist() == [False, False, True]


# tensordict 0.14.3 moves a buffer by assigning its data, which torch refuses between a
# real device and the meta device. From one real device to another it does not.
@pytest.mark.parametrize("loss_class", [OSRLoss, SACLoss])
def test_losses_of_torchrl_cannot_be_moved_to_meta(make_networks, loss_class) -> None:
    networks = make_networks()
    options = {"recovery_weight": 0.0} if loss_class is OSRLoss else {}
    loss = loss_class(
        networks.actor, networks.critics, target_entropy=-2.0, **options
    ).double()
    with pytest.raises(RuntimeError, match="incompatible tensor type"):
        loss.to("meta")
