"""IQLLoss against a plain restatement of its equations.

"Offline Reinforcement Learning with Implicit Q-Learning" (Kostrikov et al. 2021,
https://arxiv.org/abs/2110.06169).
"""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal
from torchrl import objectives
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.losses import IQLLoss
from torchrl_osr.modules import critic_ensemble, gaussian_actor, state_value

GAMMA, BETA, TAU, TARGET_SCALE = 0.875, 2.0, 0.8, 0.5
SETTINGS = {"temperature": BETA, "expectile": TAU}


@pytest.fixture(autouse=True)
def _in_float64():
    """Networks that were never rounded to float32."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def networks(scale: float | None = None, number: int = 2) -> SimpleNamespace:
    torch.manual_seed(0)
    cells = {"num_cells": [8]}
    critics = critic_ensemble(3, 2, num_qvalue_nets=number, layer_norm=True, **cells)
    return SimpleNamespace(
        actor=gaussian_actor(3, 2, scale=scale, **cells),
        critics=critics,
        value=state_value(3, layer_norm=True, **cells),
    )


def make_loss(nets, loss_class=IQLLoss, **options):
    options = {"num_qvalue_nets": len(nets.critics)} | SETTINGS | options
    loss = loss_class(nets.actor, nets.critics, nets.value, **options)
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda each: each.mul_(TARGET_SCALE))
    return loss


def restated(nets, batch, *, squared: bool) -> dict[str, Tensor]:
    """The losses, one critic at a time; no torchrl_osr."""
    critics, value = [each.module for each in nets.critics], nets.value.module
    old = copy.deepcopy(critics)
    for network in old:
        for parameter in network.parameters():
            parameter.data.mul_(TARGET_SCALE)
    s, a, s_next = batch["observation"], batch["action"], batch["next", "observation"]
    sa = torch.cat([s, a], -1)
    with torch.no_grad():
        lowest = torch.min(torch.stack([q(sa) for q in old]), 0).values
        target = batch["next", "reward"] + GAMMA * torch.where(
            batch["next", "terminated"], 0.0, value(s_next)
        )
    u = lowest - value(s)
    weight = torch.clamp(torch.exp(BETA * u.detach()), max=100).squeeze(-1)
    mlp, tanh, spread = nets.actor.module[0].module
    mean = tanh(mlp(s))
    if squared:
        distance = (mean - a).square().sum(-1)
    else:
        std = spread.state_independent_scale.exp()
        distance = -Normal(mean, std).log_prob(a).sum(-1)
    return {
        "loss_actor": (weight * distance).mean(),
        "loss_qvalue": sum((q(sa) - target).square().mean() for q in critics),
        "loss_value": (torch.where(u < 0, 1 - TAU, TAU) * u.square()).mean(),
    }


def gradients_of(losses, nets) -> list[Tensor]:
    """Each loss by its own network, critics stacked."""
    actor = [each for each in nets.actor.parameters() if each.requires_grad]
    found = list(torch.autograd.grad(losses["loss_actor"], actor))
    for pair in zip(*(q.parameters() for q in nets.critics), strict=True):
        each = torch.autograd.grad(losses["loss_qvalue"], pair, retain_graph=True)
        found.append(torch.stack(each))
    found += torch.autograd.grad(losses["loss_value"], list(nets.value.parameters()))
    return found


@pytest.mark.parametrize("deactivate_vmap", [True, False])
@pytest.mark.parametrize("number", [2, 3])
def test_losses_and_gradients_equal_the_restatement(
    make_batch, check, deactivate_vmap, number
) -> None:
    batch, nets = make_batch(20), networks(number=number)
    loss = make_loss(networks(number=number), deactivate_vmap=deactivate_vmap)
    out, expected = loss(batch), restated(nets, batch, squared=False)
    losses = {key: out[key] for key in expected}
    check("IQL", losses.values(), expected.values(), tolerance=1e-10)
    # The sum of ours is correct training; the plain one needs each group by itself.
    sum(losses.values()).backward()
    ours = [*loss.actor_network_params.values(True, True)]
    ours += loss.qvalue_network_params.values(True, True)
    ours += loss.value_network_params.values(True, True)
    got = [each.grad for each in ours]
    wanted = gradients_of(expected, nets)
    assert len(got) == len(wanted)
    # In an order of their own: the actor's scale comes last in tensordicts.
    key = [(tuple(each.shape), each.norm().item()) for each in wanted]
    order = sorted(range(len(key)), key=key.__getitem__)
    mine = sorted(got, key=lambda each: (tuple(each.shape), each.norm().item()))
    check("IQL", mine, [wanted[index] for index in order], tolerance=1e-10)


def test_with_variance_one_half_the_policy_is_cloned_by_squared_error(
    make_batch, check
) -> None:
    batch, nets, scale = make_batch(20), networks(), 0.5**0.5
    loss = make_loss(networks(scale=scale))
    expected = restated(nets, batch, squared=True)["loss_actor"]
    parameters = list(nets.actor.module[0].module[0].parameters())
    wanted = torch.autograd.grad(expected, parameters)
    loss(batch)["loss_actor"].backward()
    got = [each.grad for each in loss.actor_network_params.parameters()]
    check("IQL", got, wanted, tolerance=1e-10)


def test_it_is_torchrls_but_for_defaults_names_and_what_it_writes(make_batch) -> None:
    ours = make_loss(networks())
    theirs = make_loss(networks(), objectives.IQLLoss, loss_function="l2")
    batch, other = make_batch(20), make_batch(20)
    out, wanted = ours(batch), theirs(other)
    for name, key in zip(ours.out_keys, theirs.out_keys, strict=True):
        assert torch.equal(out[name], wanted[key])
    new = set(batch.keys()) - set(make_batch(20).keys())
    assert new == {"td_error"}
    assert torch.equal(batch["td_error"], other["td_error"])
    after = [("next", key) for key in ("observation", "reward", "done", "terminated")]
    assert ours.in_keys == ["observation", "action", *after]


def test_defaults_are_the_authors() -> None:
    nets = networks()
    loss = IQLLoss(nets.actor, nets.critics, nets.value)
    assert (loss.expectile, loss.temperature, loss.loss_function) == (0.7, 3.0, "l2")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"expectile": 1.0}, "expectile must be between 0 and 1, got 1.0"),
        ({"temperature": -1.0}, "temperature must be at least 0, got -1"),
        ({"loss_function": "l3"}, "loss_function must be one of"),
    ],
)
def test_options_out_of_their_range_are_refused(options, message) -> None:
    nets = networks()
    with pytest.raises(ValueError, match=message):
        IQLLoss(nets.actor, nets.critics, nets.value, **options)


def test_the_mean_of_the_actor_is_within_the_bounds_and_its_scale_is_learnt() -> None:
    actor, fixed = networks().actor, networks(0.3).actor
    states = 100 * torch.randn(50, 3)
    loc, scale = actor.module[0].module(states)
    assert loc.abs().max() <= 1
    assert (scale == 1).all()
    assert len(list(actor.parameters())) == len(list(fixed.parameters())) + 1


def test_what_follows_an_end_is_never_read(make_batch) -> None:
    batch = make_batch(10, twin=False)
    wanted = make_loss(networks())(batch)["loss_qvalue"]
    ended = batch["next", "terminated"].squeeze(-1)
    assert ended.any()
    batch["next", "observation"][ended] = torch.nan
    assert torch.equal(make_loss(networks())(batch)["loss_qvalue"], wanted)


def test_a_list_of_critics_has_its_own_length(make_batch) -> None:
    nets, critics = networks(), critic_ensemble(3, 2, num_qvalue_nets=4)
    loss = IQLLoss(nets.actor, critics, nets.value)
    SoftUpdate(loss, tau=0.1)
    assert loss.num_qvalue_nets == 4
    assert loss(make_batch(4, twin=False))["loss_qvalue"].isfinite()


def test_imagined_rows_are_refused(make_batch) -> None:
    batch = make_batch(4, twin=False)
    batch["imagined"] = torch.zeros(4, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match="learns from the data's actions alone"):
        make_loss(networks())(batch)


def test_a_policy_without_spread_is_refused() -> None:
    with pytest.raises(ValueError, match="scale must be above 0"):
        gaussian_actor(3, 2, scale=0.0)
