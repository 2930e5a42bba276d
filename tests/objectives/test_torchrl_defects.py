"""Where TorchRL 0.14.1 is wrong. A failure says that TorchRL has mended it."""

from __future__ import annotations

import math

import pytest
import torch
import torchrl.objectives
from objectives.losses import BOX, Networks, make_batch, update_targets
from torchrl.data.postprocs import MultiStep
from torchrl.objectives import CQLLoss, SACLoss
from torchrl.objectives import TD3BCLoss as TorchRLsTD3BC

from torchrl_osr import CQLLoss as OurCQL
from torchrl_osr.lab.losses import TD3BCLoss

NUM_RANDOM = 10
# With zero values a log-sum-exp of n importance weights tends to log(n |A|), because
# each weight 1/p has the mean |A| = 4, the area of [-1, 1]^2. Two critics. From below,
# by Jensen's inequality.
ALL_ACTIONS = 2 * math.log(3 * NUM_RANDOM * 4)  # all 3K actions of a state: CQL(H)
THREE_ACTIONS = 2 * math.log(3 * 4)  # one action of each kind at a time


def make_loss(loss_class: type, networks: Networks, **options):
    if loss_class is CQLLoss:
        options = {"loss_function": "l2"} | options
    options = {"target_entropy": -2.0} | options
    loss = loss_class(networks.actor, networks.critics, **options)
    return update_targets(loss.double())


def penalties(weight: float) -> dict[str, float]:
    """Return ``loss_cql`` of both libraries for values ``weight`` times a state."""
    found = {}
    for name, loss_class in {"ours": OurCQL, "torchrl": CQLLoss}.items():
        networks = Networks()
        for critic in networks.critics:
            first, _, last = critic.module
            for parameter in critic.parameters():
                parameter.data.zero_()
            first.weight.data[0, 0] = 1.0
            last.weight.data[0, 0] = weight
        options = {"min_q_weight": 1.0, "num_random": NUM_RANDOM}
        loss = make_loss(loss_class, networks, **options)
        torch.manual_seed(1)
        found[name] = loss(make_batch("cql", 256))["loss_cql"].item()
    return found


# TorchRL is wrong: Kumar et al. 2020, appendix F, and the authors' released code take
# one log-sum-exp over all the actions of a state. Both terms of the gap belong to the
# same state, so that a value which ignores the action cancels. TorchRL takes three
# actions at a time, and scores the actions of pi(s') at s'.
def test_cql_loss_of_torchrl_sums_three_actions_and_scores_some_elsewhere() -> None:
    flat, steep = penalties(0.0), penalties(30.0)
    assert ALL_ACTIONS - 0.3 < flat["ours"] < ALL_ACTIONS + 0.1
    assert THREE_ACTIONS - 0.8 < flat["torchrl"] < THREE_ACTIONS + 0.1
    assert steep["ours"] == pytest.approx(flat["ours"], abs=1e-9)
    assert abs(steep["torchrl"] - flat["torchrl"]) > 1.0


# TorchRL is wrong: the multiplier is to rise while the critics lower the gap. Its
# multiplier's loss is not detached from the critics, and with one backward over the sum
# of the losses, as in its own example, it raises the gap.
def test_cql_loss_of_torchrl_lets_the_multiplier_train_the_critics() -> None:
    gradients, ours, theirs = {}, {"target_action_gap": 10.0}, {"with_lagrange": True}
    for loss_class, option in ((OurCQL, ours), (CQLLoss, theirs)):
        loss = make_loss(loss_class, Networks(), min_q_weight=1.0, **option)
        out = loss(make_batch("cql", 64))
        critics = list(loss.qvalue_network_params.parameters())
        gradients[loss_class] = [
            torch.autograd.grad(out[key], critics, retain_graph=True, allow_unused=True)
            for key in ("loss_cql", "loss_alpha_prime")
        ]
    assert all(gradient is None for gradient in gradients[OurCQL][1])
    conservative, multiplier = (
        torch.cat([gradient.flatten() for gradient in group])
        for group in gradients[CQLLoss]
    )
    cosine = torch.cosine_similarity(conservative, multiplier, dim=0)
    assert cosine.item() == pytest.approx(-1.0, abs=1e-6)


# TorchRL is wrong: a mean over weights that are all 0 is 0 / 0. A buffer may hand out
# such a batch where priorities are 0.
def test_weighted_mean_of_torchrl_over_no_weight_is_nan() -> None:
    batch = make_batch("cql", 10)
    batch["priority_weight"] = torch.zeros(10, dtype=torch.float64)
    assert make_loss(SACLoss, Networks())(batch.clone())["loss_qvalue"].isnan()
    assert make_loss(OurCQL, Networks())(batch)["loss_qvalue"] == 0


# TorchRL is wrong: the cloning term is a mean over the batch that is added to each
# row, so that a row which is masked out still pulls the policy.
def test_cloning_term_of_torchrl_ignores_masks() -> None:
    batch = make_batch("td3-bc", 10)
    batch["collector", "mask"] = (torch.arange(10) < 5).unsqueeze(-1)
    spoiled = batch.clone()
    spoiled["action"][5:] = 0.99
    same, theirs = {}, {"bounds": (-1.0, 1.0)}
    for loss_class, bounds in ((TD3BCLoss, BOX), (TorchRLsTD3BC, theirs)):
        networks = Networks()
        networks.actor = torchrl.modules.Actor(networks.module.module)
        loss = loss_class(networks.actor, networks.critics, **bounds).double()
        update_targets(loss)
        values = [loss(each.clone())["loss_actor"] for each in (batch, spoiled)]
        same[loss_class] = torch.equal(*values)
    assert same == {TD3BCLoss: True, TorchRLsTD3BC: False}


# TorchRL is wrong: the next state moves to where the n steps end, the flags do not. A
# return that reaches the terminal state is bootstrapped from it, by every loss.
def test_multi_step_of_torchrl_leaves_the_flags_of_the_first_step() -> None:
    batch = make_batch("cql", 1, 3, ends=False)
    batch["next", "terminated"][:, 2] = True
    batch["next", "done"] = batch["next", "terminated"].clone()
    shifted = MultiStep(0.9, 3)(batch.clone())
    assert shifted["steps_to_next_obs"].tolist() == [[3, 2, 1]]
    last = batch["next", "observation"][:, 2:].expand(1, 3, 3)
    assert torch.equal(shifted["next", "observation"], last)
    assert shifted["next", "terminated"].flatten().tolist() == [False, False, True]
