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
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, OSRVLoss, StateRecoveryLoss

CONTINUOUS = ["osr", "cql", "osrv", "idm", "recovery"]
RECOVERING = ["osr", "osrv", "recovery"]


@pytest.mark.parametrize("continuous", CONTINUOUS)
def test_other_distribution_families_are_refused(family, continuous) -> None:
    networks = family.networks(continuous, distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"network must end in a TanhNormal.*Truncated"):
        family(continuous, networks)


@pytest.mark.parametrize("wrong", ["actor", "inverse_dynamics"])
@pytest.mark.parametrize("continuous", RECOVERING)
def test_one_network_has_another_distribution_family(family, continuous, wrong) -> None:
    networks = family.networks(continuous)
    other = family.networks(continuous, distribution_class=TruncatedNormal)
    setattr(networks, wrong, getattr(other, wrong))
    with pytest.raises(TypeError, match=f"{wrong}_network must end in a TanhNormal"):
        family(continuous, networks)


def test_losses_that_do_not_use_the_model_do_not_look_at_it(
    family, unrecovering
) -> None:
    networks = family.networks(unrecovering)
    other = "osr" if family[unrecovering].discrete else "discrete"
    networks.inverse_dynamics = family.networks(other).inverse_dynamics
    family(unrecovering, networks)


@pytest.mark.parametrize("discrete", ["discrete", "discrete-idm"])
def test_continuous_networks_are_sent_to_the_continuous_loss(family, discrete) -> None:
    expected = "must end in a categorical .*got TanhNormal.* use OSRLoss.*Dynamics"
    with pytest.raises(TypeError, match=expected):
        family(discrete, family.networks("osr"))
    other = family.networks("osr", distribution_class=TruncatedNormal)
    with pytest.raises(TypeError, match=r"got TruncatedNormal\. torchrl_osr.modules"):
        family(discrete, other)


@pytest.mark.parametrize("continuous", ["osr", "idm"])
@pytest.mark.parametrize("one_hot", [True, False])
def test_discrete_networks_are_sent_to_the_discrete_loss(
    family, continuous, one_hot
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    networks = family.networks("discrete", **kwargs)
    expected = "must end in a TanhNormal.*Categorical.*DiscreteOSRLoss"
    with pytest.raises(TypeError, match=expected):
        family(continuous, networks)


def test_only_the_model_is_continuous(family) -> None:
    networks = family.networks("discrete")
    networks.inverse_dynamics = family.networks("osr").inverse_dynamics
    with pytest.raises(TypeError, match="inverse_dynamics_network must end in a cat"):
        family("discrete", networks)


@pytest.mark.parametrize(
    ("low", "high"), [(-2.0, 1.0), (-1.0, 2.0), (-1.0, torch.tensor([1.0, 2.0]))]
)
@pytest.mark.parametrize("bounded", [*RECOVERING, "recovery-delta"])
def test_bounds_that_differ_are_refused(family, bounded, low, high) -> None:
    networks = family.networks(bounded)
    other = family.networks(bounded, low=low, high=high)
    networks.inverse_dynamics = other.inverse_dynamics
    with pytest.raises(ValueError, match=r"share their action bounds.*2\.0"):
        family(bounded, networks)


@pytest.mark.parametrize("bounded", [*RECOVERING, "recovery-delta"])
def test_bounds_may_be_numbers_or_tensors(family, family_batch, bounded) -> None:
    networks = family.networks(bounded)
    other = family.networks(bounded, low=-torch.ones(2), high=torch.ones(2))
    networks.inverse_dynamics = other.inverse_dynamics
    out = family(bounded, networks)(family_batch(bounded, 10))
    assert out["loss_recovery"].isfinite()


@pytest.mark.parametrize("value", [-0.5, math.inf, math.nan])
def test_weights_that_are_none_are_refused(family, scheduled, value) -> None:
    for weight in family[scheduled].weights:
        expected = rf"{weight} must be at least 0, got {value}"
        with pytest.raises(ValueError, match=expected):
            family(scheduled, **{weight: value})


OPTIONS = {
    "temperature": [0.0, math.nan],
    "loss_function": ["huber"],
    "reduction": ["median"],
    "scalar_output_mode": ["keep"],
}
DIRECTIONS = {"recovery_direction": ["backward"], "action_reduction": ["max"]}
STATES = {"recovery_states": ["noisy"], "actor_states": ["perturbed"]}
WRONG = {
    "osr": OPTIONS
    | DIRECTIONS
    | STATES
    | {"num_random": [0], "recovery_target": ["model"]},
    "cql": OPTIONS | {"num_random": [0]},
    "osrv": OPTIONS | {"num_random": [0]},
    "discrete": OPTIONS | STATES | {"recovery_direction": ["both"]},
    "recovery": {
        "direction": ["backward"],
        "action_reduction": ["max"],
        "states": ["noisy"],
        "reduction": ["median"],
    },
    "idm": {"reduction": ["median"]},
    "discrete-idm": {"states": ["noisy"], "reduction": ["median"]},
}


@pytest.mark.parametrize("optional", WRONG)
def test_options_out_of_range_are_named(family, optional) -> None:
    for option, values in WRONG[optional].items():
        for value in values:
            with pytest.raises(ValueError, match=f"must be .*{value}") as error:
                family(optional, **{option: value})
            assert option in str(error.value)


CHOICES = {
    "osr": [*DIRECTIONS, *STATES, "loss_function", "reduction", "scalar_output_mode"],
    "osrv": ["policy_values", "loss_function"],
    "discrete": [*STATES, "recovery_direction", "loss_function"],
    "recovery": ["direction", "action_reduction", "states", "reduction"],
    "idm": ["states", "loss_function", "reduction"],
    "discrete-idm": ["states"],
}


@pytest.mark.parametrize("choosing", CHOICES)
def test_unknown_choices_list_the_known_ones(family, choosing) -> None:
    for option in CHOICES[choosing]:
        expected = rf"^{option} must be one of \(.*\), got 'unknown'\.$"
        with pytest.raises(ValueError, match=expected):
            family(choosing, **{option: "unknown"})


@pytest.mark.parametrize("value", ["max", None])
def test_unknown_policy_values_are_named(family, value) -> None:
    expected = rf"policy_values must be one of \('mean', 'logsumexp'\), got {value!r}"
    with pytest.raises(ValueError, match=expected):
        family("osrv", policy_values=value)


@pytest.mark.parametrize("recovers", ["osr", "osrv", "discrete"])
def test_recovery_without_a_model_is_refused(family, recovers) -> None:
    networks = family.networks(recovers)
    networks.inverse_dynamics = None
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        family(recovers, networks)


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


@pytest.mark.parametrize("sharing", ["osr", "osrv"])
@pytest.mark.parametrize(
    "kind", ["critics", "layer of two critics", "actor and model", "actor and critic"]
)
def test_networks_with_common_parameters_are_refused(family, sharing, kind) -> None:
    networks = family.networks(sharing)
    shares(kind, networks)
    with pytest.raises(ValueError, match=r"share a parameter of shape .*deepcopy"):
        family(sharing, networks)


def test_no_critics_at_all_are_refused(family, critic_loss) -> None:
    networks = family.networks(critic_loss, num_critics=0)
    with pytest.raises(ValueError, match="at least one critic"):
        family(critic_loss, networks)


def deep_networks(size: int, *, tells: bool) -> ProbabilisticActor:
    """An actor whose last layers tell its actions' size, or do not."""
    head = nn.Sequential(nn.Linear(3, 2 * size), NormalParamExtractor())
    if not tells:
        head.append(Pair())
    return ProbabilisticActor(
        TensorDictModule(head, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    ).double()


class Pair(nn.Module):
    """Hides what comes before behind a layer that nobody knows."""

    def __init__(self) -> None:
        super().__init__()
        self.last = nn.Linear(1, 1)

    def forward(self, pair):
        return pair


# A model of one dimension would broadcast against any policy.
@pytest.mark.parametrize("loss_class", [OSRLoss, OSRVLoss, StateRecoveryLoss])
@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("tells", [True, False])
def test_model_of_another_action_size_is_refused(
    make_networks, make_batch, loss_class, size, tells
) -> None:
    networks = make_networks()
    networks.inverse_dynamics = deep_networks(size, tells=tells)
    arguments = [networks.actor, networks.critics, networks.inverse_dynamics]
    if loss_class is StateRecoveryLoss:
        del arguments[1]

    def build_and_call() -> None:
        loss = loss_class(*arguments)
        assert not tells, "it is to be refused at construction"
        if loss_class is not StateRecoveryLoss:
            SoftUpdate(loss, tau=0.1)
        loss.double()(make_batch(4))

    with pytest.raises(
        ValueError, match=f"has {size} actions, but actor_network has 2"
    ):
        build_and_call()
