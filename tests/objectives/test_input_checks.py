"""Errors about the batch: which entry is wrong, and what was expected."""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Categorical


@pytest.mark.parametrize("prefix", ["perturbed", "noisy"])
def test_missing_twin_is_named_with_the_cure(
    family, family_batch, twin_reading, prefix
) -> None:
    loss = family(twin_reading)
    loss.set_keys(perturbed=prefix)
    with pytest.raises(KeyError, match=f"{prefix}.*observation.*StatePerturbation"):
        loss(family_batch(twin_reading, 10, twin=False))


def test_twin_of_another_shape_is_named(family, family_batch, twin_reading) -> None:
    batch = family_batch(twin_reading, 10)
    batch["perturbed", "observation"] = torch.zeros(10, 4)
    with pytest.raises(ValueError, match=r"'perturbed', 'observation'.*4.*10, 3"):
        family(twin_reading)(batch)


def test_next_state_of_another_shape_is_named(family, family_batch, name) -> None:
    batch = family_batch(name, 10)
    batch["next", "observation"] = torch.zeros(10, 1)
    with pytest.raises(ValueError, match=r"'next', 'observation'.*10, 1.*10, 3"):
        family(name)(batch)


def test_missing_entry_is_named(family, family_batch, name) -> None:
    loss, batch = family(name), family_batch(name, 10)
    for key in family[name].in_keys:
        named = key if isinstance(key, str) else ".*".join(key)
        with pytest.raises(KeyError, match=named):
            loss(batch.exclude(key))


def test_flags_and_rewards_need_a_last_dimension_of_one(
    family, family_batch, name
) -> None:
    flags = {("next", key) for key in ("reward", "done", "terminated")}
    for key in flags.intersection(family[name].in_keys):
        batch = family_batch(name, 10)
        batch[key] = batch[key].squeeze(-1)
        expected = rf"'{key[1]}'\) has shape \(10,\).*\(10, 1\)"
        with pytest.raises(ValueError, match=expected):
            family(name)(batch)


@pytest.mark.parametrize("acting", ["osr", "cql", "osrv", "idm", "idm-mse", "cvae"])
def test_action_of_another_size_is_named(family, family_batch, acting) -> None:
    batch = family_batch(acting, 10)
    batch["action"] = torch.zeros(10, 5, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"'action' has shape \(10, 5\).* 2 dim"):
        family(acting)(batch)


SEEN = r"'action' has shape \({}\) and type torch.{}; expected "
ONE_HOT = SEEN + r"one-hot actions \(2, 5, 4\), .* OneHotCategorical"
INDEX = SEEN + r"integer indices \(2, 5\) or \(2, 5, 1\), .* Categorical"


@pytest.mark.parametrize("choosing", ["discrete", "discrete-idm"])
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
    family, family_batch, choosing, one_hot, action, expected
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    loss = family(choosing, family.networks(choosing, **kwargs))
    batch = family_batch(choosing, 2, 5)
    batch["action"] = action
    with pytest.raises(ValueError, match=expected):
        loss(batch)


@pytest.mark.parametrize(
    ("option", "name_of_network"),
    [
        ("num_model_actions", "inverse_dynamics_network"),
        ("num_critic_actions", "qvalue_network"),
    ],
)
def test_numbers_of_actions_that_differ_are_named(
    family, family_batch, option, name_of_network
) -> None:
    networks = family.networks("discrete", **{option: 5})
    batch = family_batch("discrete", 10)
    expected = f"{name_of_network} has 5 actions, but actor_network has 4"
    # A model tells its number at construction, critics in the call.
    with pytest.raises(ValueError, match=expected):
        family("discrete", networks)(batch)


def test_continuous_critics_are_refused(family, family_batch) -> None:
    networks = family.networks("discrete")
    networks.critics = family.networks("osr").critics
    with pytest.raises(ValueError, match="critics read 'action'.*discrete_critic_ens"):
        family("discrete", networks)(family_batch("discrete", 10))


def test_critics_that_write_another_entry_are_named(
    family, family_batch, critic_loss
) -> None:
    networks = family.networks(critic_loss)
    (key,) = networks.critics[0].out_keys
    for critic in networks.critics:
        critic.out_keys = ["values"]
    with pytest.raises(KeyError, match=rf"write \['values'\], not '{key}'"):
        family(critic_loss, networks)(family_batch(critic_loss, 10))
