"""Errors that say which entry or network is wrong, and what was expected."""

from __future__ import annotations

import pytest
import torch
from torchrl.modules import TruncatedNormal
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss


def build(name: str, networks, **kwargs):
    if name == "idm":
        return InverseDynamicsLoss(networks.inverse_dynamics, **kwargs)
    if name == "cql":
        kwargs["recovery_weight"] = 0.0
    loss = OSRLoss(
        networks.actor, networks.critics, networks.inverse_dynamics, **kwargs
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


@pytest.mark.parametrize("name", ["osr", "idm"])
@pytest.mark.parametrize("prefix", ["perturbed", "noisy"])
def test_missing_twin_is_named_with_the_cure(
    make_networks, make_batch, name, prefix
) -> None:
    loss = build(name, make_networks())
    loss.set_keys(perturbed=prefix)
    with pytest.raises(KeyError, match=f"{prefix}.*observation.*StatePerturbation"):
        loss(make_batch(10, twin=False))


@pytest.mark.parametrize("name", ["osr", "idm"])
def test_twin_of_another_shape_is_named(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["perturbed", "observation"] = torch.zeros(10, 4)
    with pytest.raises(ValueError, match=r"'perturbed', 'observation'.*4.*10, 3"):
        loss(batch)


@pytest.mark.parametrize("name", ["osr", "cql", "idm"])
def test_next_state_of_another_shape_is_named(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["next", "observation"] = torch.zeros(10, 1)
    with pytest.raises(ValueError, match=r"'next', 'observation'.*10, 1.*10, 3"):
        loss(batch)


SHARED = ["observation", "action", ("next", "observation"), ("next", "done")]
CRITIC_ONLY = [("next", "reward"), ("next", "terminated")]
READ = [(name, key) for name in ("osr", "cql", "idm") for key in SHARED]
READ += [(name, key) for name in ("osr", "cql") for key in CRITIC_ONLY]


@pytest.mark.parametrize(("name", "key"), READ, ids=str)
def test_missing_entry_is_named(make_networks, make_batch, name, key) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    leaf = key if isinstance(key, str) else key[-1]
    with pytest.raises(KeyError, match=leaf):
        loss(batch.exclude(key))


@pytest.mark.parametrize("name", ["osr", "cql", "idm"])
def test_other_distribution_families_are_refused(make_networks, name) -> None:
    networks = make_networks(distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"network must end in a TanhNormal.*Truncated"):
        build(name, networks)


def test_only_the_model_has_another_distribution_family(make_networks) -> None:
    networks = make_networks()
    other = make_networks(distribution_class=TruncatedNormal)
    networks.inverse_dynamics = other.inverse_dynamics
    with pytest.raises(TypeError, match="inverse_dynamics_network must end in"):
        build("osr", networks)
    build("cql", networks)  # which has no use for the model


@pytest.mark.parametrize(
    ("low", "high"), [(-2.0, 1.0), (-1.0, 2.0), (-1.0, torch.tensor([1.0, 2.0]))]
)
def test_bounds_that_differ_are_refused(make_networks, low, high) -> None:
    networks = make_networks()
    networks.inverse_dynamics = make_networks(low=low, high=high).inverse_dynamics
    with pytest.raises(ValueError, match=r"share their action bounds.*2\.0"):
        build("osr", networks)


def test_bounds_may_be_numbers_or_tensors(make_networks, make_batch) -> None:
    networks = make_networks()
    bounds = {"low": -torch.ones(2), "high": torch.ones(2)}
    networks.inverse_dynamics = make_networks(**bounds).inverse_dynamics
    assert build("osr", networks)(make_batch(10))["loss_recovery"].isfinite()


@pytest.mark.parametrize("weight", ["recovery_weight", "min_q_weight"])
def test_negative_weights_are_refused(make_networks, weight) -> None:
    with pytest.raises(ValueError, match=rf"{weight} must be at least 0, got -0\.5"):
        build("osr", make_networks(), **{weight: -0.5})


def test_recovery_without_a_model_is_refused(make_networks) -> None:
    networks = make_networks()
    networks.inverse_dynamics = None
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        build("osr", networks)


@pytest.mark.parametrize("name", ["osr", "cql", "idm"])
def test_action_of_another_size_is_named(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["action"] = torch.zeros(10, 5, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"'action' has shape \(10, 5\).* 2 dim"):
        loss(batch)


@pytest.mark.parametrize("key", ["reward", "done", "terminated"])
def test_flags_and_rewards_need_a_last_dimension_of_one(
    make_networks, make_batch, key
) -> None:
    loss, batch = build("osr", make_networks()), make_batch(10)
    batch["next", key] = batch["next", key].squeeze(-1)
    with pytest.raises(ValueError, match=rf"'{key}'\) has shape \(10,\).*\(10, 1\)"):
        loss(batch)
