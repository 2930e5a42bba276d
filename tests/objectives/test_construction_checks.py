"""Errors at construction: which network or option is wrong, and what was expected."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import (
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    TruncatedNormal,
)

from torchrl_osr import OSRVLoss
from torchrl_osr.lab.losses import EDACLoss

RECOVERING = ["osr", "osrv", "recovery"]


@pytest.mark.losses("osr", "cql", "osrv", "edac", "idm", "recovery")
def test_other_distribution_families_are_refused(family, name) -> None:
    networks = family.networks(name, distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"network must end in a TanhNormal.*Truncated"):
        family(name, networks)


@pytest.mark.parametrize("wrong", ["actor", "inverse_dynamics"])
@pytest.mark.losses(*RECOVERING)
def test_one_network_has_another_distribution_family(family, name, wrong) -> None:
    networks = family.networks(name)
    other = family.networks(name, distribution_class=TruncatedNormal)
    setattr(networks, wrong, getattr(other, wrong))
    with pytest.raises(TypeError, match=f"{wrong}_network must end in a TanhNormal"):
        family(name, networks)


@pytest.mark.losses("cql", "cloning", "discrete-cql")
def test_losses_that_do_not_use_the_model_do_not_look_at_it(family, name) -> None:
    networks = family.networks(name)
    other = "osr" if family[name].discrete else "discrete"
    networks.inverse_dynamics = family.networks(other).inverse_dynamics
    held = family(name, networks).state_dict()
    assert not any(key.startswith("inverse_dynamics") for key in held)


def test_continuous_networks_are_sent_to_the_continuous_loss(family) -> None:
    expected = "must end in a categorical .*got TanhNormal.* use OSRLoss"
    with pytest.raises(TypeError, match=expected):
        family("discrete", family.networks("osr"))
    other = family.networks("osr", distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"got TruncatedNormal\. torchrl_osr.modules"):
        family("discrete", other)


@pytest.mark.parametrize("one_hot", [True, False])
def test_discrete_networks_are_sent_to_the_discrete_loss(family, one_hot) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    networks = family.networks("discrete", **kwargs)
    expected = "must end in a TanhNormal.*Categorical.*DiscreteOSRLoss"
    with pytest.raises(TypeError, match=expected):
        family("osr", networks)


def test_only_the_model_is_continuous(family) -> None:
    networks = family.networks("discrete")
    networks.inverse_dynamics = family.networks("osr").inverse_dynamics
    with pytest.raises(TypeError, match="inverse_dynamics_network must end in a cat"):
        family("discrete", networks)


@pytest.mark.parametrize(
    ("low", "high"), [(-2.0, 1.0), (-1.0, 2.0), (-1.0, torch.tensor([1.0, 2.0]))]
)
@pytest.mark.losses(*RECOVERING, "recovery-delta")
def test_bounds_that_differ_are_refused(family, name, low, high) -> None:
    networks = family.networks(name)
    networks.inverse_dynamics = family.networks(
        name, low=low, high=high
    ).inverse_dynamics
    with pytest.raises(ValueError, match=r"share their action bounds.*2\.0"):
        family(name, networks)


@pytest.mark.losses(*RECOVERING, "recovery-delta")
def test_bounds_may_be_numbers_or_tensors(
    family, family_batch, record, assert_same_bits, name
) -> None:
    batch, networks = family_batch(name, 10), family.networks(name)
    expected = record(family(name), batch)
    tensors = {"low": -torch.ones(2), "high": torch.ones(2)}
    networks.inverse_dynamics = family.networks(name, **tensors).inverse_dynamics
    assert_same_bits(record(family(name, networks), batch), expected)


@pytest.mark.losses(having="weights")
@pytest.mark.parametrize("value", [-0.5, math.inf, math.nan])
def test_weights_out_of_range_are_named(family, name, value) -> None:
    for weight in family[name].weights:
        expected = rf"{weight} must be at least 0, got {value}"
        with pytest.raises(ValueError, match=expected):
            family(name, **{weight: value})


COMMON = {"reduction": ["median"]}
CRITICS = COMMON | {"loss_function": ["huber"], "scalar_output_mode": ["keep"]}
SOFT = CRITICS | {"alpha_init": [0.0, -1.0]}
STATES = {"recovery_states": ["noisy", None]}
DIRECTION = {"recovery_direction": ["backward"]}
DIVERGENCE = STATES | DIRECTION | {"action_reduction": ["max"]}
DRAWS = {"num_random": [0], "temperature": [0.0, math.nan, math.inf]}
WRONG = {
    "osr": SOFT
    | DIVERGENCE
    | DRAWS
    | {"recovery_target": ["model"], "actor_states": ["noisy"], "chunk_size": [0]},
    "osrv": SOFT | DRAWS | {"policy_values": ["max", None]},
    "edac": SOFT,
    "td3bc": CRITICS
    | {"alpha": [-1.0], "policy_noise": [-0.2], "noise_clip": [-0.5], "high": [-1.0]},
    "discrete": SOFT
    | STATES
    | DIRECTION
    | {"temperature": [0.0], "actor_states": ["noisy"]},
    "recovery": COMMON | DIVERGENCE,
    "idm": COMMON
    | {
        "states": ["perturbed", None],
        "loss_function": ["l2", None],
        "latent_weight": [-0.1, math.nan],
    },
}


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [
        (name, option, value)
        for name, options in WRONG.items()
        for option, values in options.items()
        for value in values
    ],
)
def test_options_out_of_range_are_named(family, name, option, value) -> None:
    expected = rf"^{option} must be (at least|above|one of) .*, got {value!r}\.$"
    with pytest.raises(ValueError, match=expected):
        family(name, **{option: value})


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("osr-10", {"with_lagrange": True}, "with_lagrange=True needs min_q_weight"),
        (
            "osr",
            {"max_q_backup": True, "deterministic_backup": False},
            "without entropy.*leave deterministic_backup=True",
        ),
        ("discrete-idm", {"loss_function": "mse"}, "needs actions with a distance"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    family, name, options, expected
) -> None:
    with pytest.raises(ValueError, match=expected):
        family(name, **options)


@pytest.mark.losses("osr", "osrv", "discrete")
def test_recovery_without_a_model_is_refused(family, name) -> None:
    networks = family.networks(name)
    networks.inverse_dynamics = None
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        family(name, networks)


def test_missing_model_is_named_whatever_the_weight(make_networks) -> None:
    networks = make_networks()
    with pytest.raises(ValueError, match="OSRVLoss needs an inverse_dynamics_network"):
        OSRVLoss(networks.actor, networks.critics, None, recovery_weight=0.0)


def shares(kind: str, networks) -> None:
    """Give two networks one module, or the critics one critic."""
    first, second = networks.critics[:2]
    if kind == "critics":
        networks.critics = [first, first]
    elif kind == "layer of two critics":
        second.module[0] = first.module[0]
    elif kind == "actor and model":
        networks.inverse_dynamics[0][0].module[2] = networks.actor[0][0].module[2]
    else:
        first.module[2].bias = networks.actor[0][0].module[0].bias


@pytest.mark.losses("osr", "osrv")
@pytest.mark.parametrize(
    "kind", ["critics", "layer of two critics", "actor and model", "actor and critic"]
)
def test_networks_with_common_parameters_are_refused(family, name, kind) -> None:
    networks = family.networks(name)
    shares(kind, networks)
    with pytest.raises(ValueError, match=r"share a parameter of shape .*deepcopy"):
        family(name, networks)


@pytest.mark.losses(having="critics")
def test_no_critics_at_all_are_refused(family, name) -> None:
    networks = family.networks(name, num_critics=0)
    with pytest.raises(ValueError, match="at least one critic"):
        family(name, networks)


def test_a_single_critic_cannot_be_diverse(make_networks) -> None:
    networks = make_networks(num_critics=1)
    with pytest.raises(ValueError, match="num_qvalue_nets of at least 2"):
        EDACLoss(networks.actor, networks.critics)


def model_of(size: int) -> ProbabilisticActor:
    """A model of actions of another size."""
    head = nn.Sequential(nn.Linear(3, 2 * size), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(head, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    ).double()


# A model of one dimension would broadcast against any policy.
@pytest.mark.losses(*RECOVERING)
@pytest.mark.parametrize("size", [1, 3])
def test_model_of_another_action_size_is_refused(
    family, family_batch, name, size
) -> None:
    networks = family.networks(name)
    networks.inverse_dynamics = model_of(size)
    loss = family(name, networks)
    with pytest.raises(
        ValueError, match=f"has {size} actions, but actor_network has 2"
    ):
        loss(family_batch(name, 4))
