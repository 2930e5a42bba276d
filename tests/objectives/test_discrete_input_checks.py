"""Errors of the discrete losses: what is wrong, where, and what was expected."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Categorical
from torchrl.modules import TruncatedNormal
from torchrl.objectives import SoftUpdate

from torchrl_osr import (
    DiscreteInverseDynamicsLoss,
    DiscreteOSRLoss,
    InverseDynamicsLoss,
    OSRLoss,
)


def build(networks, loss_class=DiscreteOSRLoss, **kwargs):
    if loss_class in (InverseDynamicsLoss, DiscreteInverseDynamicsLoss):
        return loss_class(networks.inverse_dynamics, **kwargs)
    loss = loss_class(
        networks.actor, networks.critics, networks.inverse_dynamics, **kwargs
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


@pytest.mark.parametrize("loss_class", [DiscreteOSRLoss, DiscreteInverseDynamicsLoss])
def test_continuous_networks_are_sent_to_the_continuous_loss(
    make_networks, loss_class
) -> None:
    expected = "must end in a categorical .*got TanhNormal.* use OSRLoss.*Dynamics"
    with pytest.raises(TypeError, match=expected):
        build(make_networks(), loss_class)
    other = make_networks(distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"got TruncatedNormal\. torchrl_osr.modules"):
        build(other, loss_class)


@pytest.mark.parametrize("loss_class", [OSRLoss, InverseDynamicsLoss])
@pytest.mark.parametrize("one_hot", [True, False])
def test_discrete_networks_are_sent_to_the_discrete_loss(
    make_discrete_networks, loss_class, one_hot
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    expected = "must end in a TanhNormal.*Categorical.*DiscreteOSRLoss"
    with pytest.raises(TypeError, match=expected):
        build(make_discrete_networks(**kwargs), loss_class)


def test_only_the_model_is_continuous(make_discrete_networks, make_networks) -> None:
    networks = make_discrete_networks()
    networks.inverse_dynamics = make_networks().inverse_dynamics
    with pytest.raises(TypeError, match="inverse_dynamics_network must end in a cat"):
        build(networks)
    build(networks, recovery_weight=0.0)  # which has no use for the model


def test_continuous_critics_are_refused(
    make_discrete_networks, make_networks, make_discrete_batch
) -> None:
    networks, batch = make_discrete_networks(), make_discrete_batch(10)
    networks.critics = make_networks().critics
    with pytest.raises(ValueError, match="critics read 'action'.*discrete_critic_ens"):
        build(networks)(batch)


def test_critics_that_write_another_entry_are_named(
    make_discrete_networks, make_discrete_batch
) -> None:
    networks, batch = make_discrete_networks(), make_discrete_batch(10)
    for critic in networks.critics:
        critic.out_keys = ["values"]
    with pytest.raises(KeyError, match=r"write \['values'\], not 'action_value'"):
        build(networks)(batch)


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("num_model_actions", "inverse_dynamics_network"),
        ("num_critic_actions", "qvalue_network"),
    ],
)
def test_numbers_of_actions_that_differ_are_named(
    make_discrete_networks, make_discrete_batch, option, name
) -> None:
    loss = build(make_discrete_networks(**{option: 5}))
    expected = f"{name} has 5 actions, but actor_network has 4"
    with pytest.raises(ValueError, match=expected):
        loss(make_discrete_batch(10))


SEEN = r"'action' has shape \({}\) and type torch.{}; expected "
ONE_HOT = SEEN + r"one-hot actions \(2, 5, 4\), .* OneHotCategorical"
INDEX = SEEN + r"integer indices \(2, 5\) or \(2, 5, 1\), .* Categorical"


@pytest.mark.parametrize("loss_class", [DiscreteOSRLoss, DiscreteInverseDynamicsLoss])
@pytest.mark.parametrize(
    ("one_hot", "action", "expected"),
    [
        (True, torch.zeros(2, 5, 3), ONE_HOT.format("2, 5, 3", "float32")),
        (True, torch.zeros(2, 5, 1).int(), ONE_HOT.format("2, 5, 1", "int32")),
        (True, torch.zeros(2, 5).long(), ONE_HOT.format("2, 5", "int64")),
        (False, torch.zeros(2, 5, 4).bool(), INDEX.format("2, 5, 4", "bool")),
        (False, torch.zeros(2, 5, 1, 1).int(), INDEX.format("2, 5, 1, 1", "int32")),
        (False, torch.zeros(2, 5), INDEX.format("2, 5", "float32")),
    ],
)
def test_actions_of_another_kind_are_named(
    make_discrete_networks, make_discrete_batch, loss_class, one_hot, action, expected
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    loss = build(make_discrete_networks(**kwargs), loss_class)
    batch = make_discrete_batch(2, 5)
    batch["action"] = action
    with pytest.raises(ValueError, match=expected):
        loss(batch)


@pytest.mark.parametrize("loss_class", [DiscreteOSRLoss, DiscreteInverseDynamicsLoss])
def test_missing_entries_are_named(
    make_discrete_networks, make_discrete_batch, loss_class
) -> None:
    loss, batch = build(make_discrete_networks(), loss_class), make_discrete_batch(10)
    for key in ("observation", "action", ("next", "observation"), ("next", "done")):
        leaf = key if isinstance(key, str) else key[-1]
        with pytest.raises(KeyError, match=leaf):
            loss(batch.exclude(key))
    with pytest.raises(KeyError, match="perturbed.*observation.*StatePerturbation"):
        loss(batch.exclude("perturbed"))


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("recovery_weight", -0.5),
        ("min_q_weight", math.nan),
        ("temperature", 0.0),
        ("temperature", math.nan),
        ("recovery_direction", "both"),
        ("recovery_states", "clean"),
        ("actor_states", "perturbed"),
        ("loss_function", "huber"),
        ("reduction", "median"),
    ],
)
def test_options_out_of_range_are_named(make_discrete_networks, option, value) -> None:
    with pytest.raises(ValueError, match=f"{option}.*{value}"):
        build(make_discrete_networks(), **{option: value})


def test_recovery_without_a_model_is_refused(make_discrete_networks) -> None:
    networks = make_discrete_networks()
    networks.inverse_dynamics = None
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        build(networks)


def test_unknown_states_of_the_model_loss_are_named(make_discrete_networks) -> None:
    with pytest.raises(ValueError, match="states must be one of .*'noisy'"):
        build(make_discrete_networks(), DiscreteInverseDynamicsLoss, states="noisy")
