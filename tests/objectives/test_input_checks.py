"""Errors that say which entry or network is wrong, and what was expected."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.modules import TruncatedNormal
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss

NAMES = ["osr", "cql", "osrv", "idm"]
RECOVERING = ["osr", "osrv"]


def build(name: str, networks, **kwargs):
    if name == "idm":
        return InverseDynamicsLoss(networks.inverse_dynamics, **kwargs)
    if name == "cql":
        kwargs["recovery_weight"] = 0.0
    loss_class = OSRVLoss if name == "osrv" else OSRLoss
    loss = loss_class(
        networks.actor, networks.critics, networks.inverse_dynamics, **kwargs
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


@pytest.mark.parametrize("name", ["osr", "osrv", "idm"])
@pytest.mark.parametrize("prefix", ["perturbed", "noisy"])
def test_missing_twin_is_named_with_the_cure(
    make_networks, make_batch, name, prefix
) -> None:
    loss = build(name, make_networks())
    loss.set_keys(perturbed=prefix)
    with pytest.raises(KeyError, match=f"{prefix}.*observation.*StatePerturbation"):
        loss(make_batch(10, twin=False))


@pytest.mark.parametrize("name", ["osr", "osrv", "idm"])
def test_twin_of_another_shape_is_named(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["perturbed", "observation"] = torch.zeros(10, 4)
    with pytest.raises(ValueError, match=r"'perturbed', 'observation'.*4.*10, 3"):
        loss(batch)


@pytest.mark.parametrize("name", NAMES)
def test_next_state_of_another_shape_is_named(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["next", "observation"] = torch.zeros(10, 1)
    with pytest.raises(ValueError, match=r"'next', 'observation'.*10, 1.*10, 3"):
        loss(batch)


SHARED = ["observation", "action", ("next", "observation"), ("next", "done")]
CRITIC_ONLY = [("next", "reward"), ("next", "terminated")]
READ = [(name, key) for name in NAMES for key in SHARED]
READ += [(name, key) for name in ("osr", "cql", "osrv") for key in CRITIC_ONLY]


@pytest.mark.parametrize(("name", "key"), READ, ids=str)
def test_missing_entry_is_named(make_networks, make_batch, name, key) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    leaf = key if isinstance(key, str) else key[-1]
    with pytest.raises(KeyError, match=leaf):
        loss(batch.exclude(key))


@pytest.mark.parametrize("name", NAMES)
def test_other_distribution_families_are_refused(make_networks, name) -> None:
    networks = make_networks(distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"network must end in a TanhNormal.*Truncated"):
        build(name, networks)


@pytest.mark.parametrize("name", RECOVERING)
def test_only_the_model_has_another_distribution_family(make_networks, name) -> None:
    networks = make_networks()
    other = make_networks(distribution_class=TruncatedNormal)
    networks.inverse_dynamics = other.inverse_dynamics
    with pytest.raises(TypeError, match="inverse_dynamics_network must end in"):
        build(name, networks)
    build("cql", networks)  # which has no use for the model


@pytest.mark.parametrize(
    ("low", "high"), [(-2.0, 1.0), (-1.0, 2.0), (-1.0, torch.tensor([1.0, 2.0]))]
)
@pytest.mark.parametrize("name", RECOVERING)
def test_bounds_that_differ_are_refused(make_networks, name, low, high) -> None:
    networks = make_networks()
    networks.inverse_dynamics = make_networks(low=low, high=high).inverse_dynamics
    with pytest.raises(ValueError, match=r"share their action bounds.*2\.0"):
        build(name, networks)


@pytest.mark.parametrize("name", RECOVERING)
def test_bounds_may_be_numbers_or_tensors(make_networks, make_batch, name) -> None:
    networks = make_networks()
    bounds = {"low": -torch.ones(2), "high": torch.ones(2)}
    networks.inverse_dynamics = make_networks(**bounds).inverse_dynamics
    assert build(name, networks)(make_batch(10))["loss_recovery"].isfinite()


@pytest.mark.parametrize(
    ("name", "weight"),
    [("osr", "recovery_weight"), ("osr", "min_q_weight"), ("osrv", "recovery_weight")],
)
@pytest.mark.parametrize("value", [-0.5, math.inf, math.nan])
def test_weights_that_are_none_are_refused(make_networks, name, weight, value) -> None:
    with pytest.raises(ValueError, match=rf"{weight} must be at least 0, got {value}"):
        build(name, make_networks(), **{weight: value})


# What every actor-critic loss asks of its options, and what OSR-v asks besides.
@pytest.mark.parametrize("name", ["osr", "cql", "osrv"])
@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("num_random", 0),
        ("temperature", 0.0),
        ("temperature", math.nan),
        ("loss_function", "huber"),
        ("reduction", "median"),
        ("scalar_output_mode", "keep"),
    ],
)
def test_options_out_of_range_are_named(make_networks, name, option, value) -> None:
    with pytest.raises(ValueError, match=f"{option}.*{value}"):
        build(name, make_networks(), **{option: value})


@pytest.mark.parametrize("value", ["max", None])
def test_unknown_policy_values_are_named(make_networks, value) -> None:
    expected = rf"policy_values must be one of \('mean', 'logsumexp'\), got {value!r}"
    with pytest.raises(ValueError, match=expected):
        build("osrv", make_networks(), policy_values=value)


def test_recovery_without_a_model_is_refused(make_networks) -> None:
    networks = make_networks()
    networks.inverse_dynamics = None
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        build("osr", networks)


@pytest.mark.parametrize("name", NAMES)
def test_action_of_another_size_is_named(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["action"] = torch.zeros(10, 5, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"'action' has shape \(10, 5\).* 2 dim"):
        loss(batch)


@pytest.mark.parametrize("name", RECOVERING)
@pytest.mark.parametrize("key", ["reward", "done", "terminated"])
def test_flags_and_rewards_need_a_last_dimension_of_one(
    make_networks, make_batch, name, key
) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    batch["next", key] = batch["next", key].squeeze(-1)
    with pytest.raises(ValueError, match=rf"'{key}'\) has shape \(10,\).*\(10, 1\)"):
        loss(batch)


@pytest.mark.parametrize("loss_class", [OSRLoss, OSRVLoss])
def test_missing_model_is_named(make_networks, loss_class) -> None:
    networks = make_networks()
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        loss_class(networks.actor, networks.critics, None)


def shares(kind: str, networks) -> None:
    """Give two networks one module, or the critics one critic."""
    first, second = networks.critics
    if kind == "critics":
        networks.critics = [first, first]
    elif kind == "layer of two critics":
        second.module[0] = first.module[0]
    elif kind == "actor and model":
        networks.inverse_dynamics[0][0].module[2] = networks.actor[0][0].module[2]
    else:
        first.module[2].bias = networks.actor[0][0].module[0].bias


@pytest.mark.parametrize("name", RECOVERING)
@pytest.mark.parametrize(
    "kind", ["critics", "layer of two critics", "actor and model", "actor and critic"]
)
def test_networks_with_common_parameters_are_refused(make_networks, name, kind) -> None:
    networks = make_networks()
    shares(kind, networks)
    with pytest.raises(ValueError, match=r"share a parameter of shape .*deepcopy"):
        build(name, networks)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("recovery_direction", "backward"),
        ("action_reduction", "max"),
        ("recovery_states", "clean"),
        ("actor_states", "perturbed"),
        ("loss_function", "huber"),
    ],
)
def test_unknown_modes_list_the_known_ones(make_networks, option, value) -> None:
    with pytest.raises(ValueError, match=rf"{option} must be one of .*, got '{value}'"):
        build("osr", make_networks(), **{option: value})
