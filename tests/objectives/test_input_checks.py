"""Errors about the batch: which entry is wrong, and what was expected."""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Categorical
from torchrl.data.postprocs import MultiStep


@pytest.mark.losses(having="perturbed")
@pytest.mark.parametrize("prefix", ["perturbed", "noisy"])
def test_missing_perturbed_state_is_named_with_the_cure(
    family, family_batch, name, prefix
) -> None:
    loss = family(name)
    loss.set_keys(perturbed=prefix)
    with pytest.raises(KeyError, match=f"{prefix}.*observation.*StatePerturbation"):
        loss(family_batch(name, 10, perturbed=False))


@pytest.mark.losses(having="perturbed")
def test_perturbed_state_of_another_shape_is_named(family, family_batch, name) -> None:
    batch = family_batch(name, 10)
    batch["perturbed", "observation"] = torch.zeros(10, 4)
    with pytest.raises(ValueError, match=r"'perturbed', 'observation'.*4.*10, 3"):
        family(name)(batch)


@pytest.mark.losses
def test_next_state_of_another_shape_is_named(family, family_batch, name) -> None:
    batch = family_batch(name, 10)
    batch["next", "observation"] = torch.zeros(10, 1)
    with pytest.raises(ValueError, match=r"'next', 'observation'.*10, 1.*10, 3"):
        family(name)(batch)


@pytest.mark.losses
def test_missing_entry_is_named(family, family_batch, name) -> None:
    loss, batch = family(name), family_batch(name, 10)
    for key in family[name].in_keys:
        named = key if isinstance(key, str) else ".*".join(key)
        with pytest.raises(KeyError, match=named):
            loss(batch.exclude(key))


@pytest.mark.losses
@pytest.mark.parametrize("size", [(0,), (4, 0)])
def test_empty_batch_is_named(family, family_batch, name, size) -> None:
    expected = rf"batch is empty \(batch_size \({size[0]},.*at least one transition"
    with pytest.raises(ValueError, match=expected):
        family(name)(family_batch(name, *size))


@pytest.mark.losses
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


@pytest.mark.losses(having="priority weight")
@pytest.mark.parametrize("shape", [(10, 2), (10, 1, 1)])
def test_priority_weights_of_another_shape_are_named(
    family, family_batch, name, shape
) -> None:
    batch = family_batch(name, 10)
    batch["priority_weight"] = torch.ones(shape)
    with pytest.raises(ValueError, match=r"'priority_weight' has shape .*one weight a"):
        family(name)(batch)


def several_steps(batch):
    """The batch as TorchRL's MultiStep makes it: next states up to two steps away."""
    return MultiStep(0.5, 2).double()(batch)


@pytest.mark.losses(having="inverse dynamics")
def test_multi_step_batches_are_refused_by_the_model(
    family, family_batch, name
) -> None:
    batch = several_steps(family_batch(name, 2, 5))
    expected = r"steps_to_next_obs up to 2\).*leave MultiStep out.*recovery_weight=0"
    with pytest.raises(ValueError, match=expected):
        family(name)(batch)
    # One step at a time may be written, too.
    batch["steps_to_next_obs"].fill_(1)
    assert all(value.isfinite() for value in family(name)(batch).values())


@pytest.mark.losses("osr", "cql", "osrv", "edac", "td3bc", "idm", "idm-mse", "cvae")
@pytest.mark.parametrize("size", [1, 5])
def test_action_of_another_size_is_named(family, family_batch, name, size) -> None:
    batch = family_batch(name, 10)
    batch["action"] = torch.zeros(10, size, dtype=torch.float64)
    expected = rf"'action' has shape \(10, {size}\).* 2 dim"
    with pytest.raises(ValueError, match=expected):
        family(name)(batch)


SEEN = r"'action' has shape \({}\) and type torch.{}; expected "
ONE_HOT = SEEN + r"one-hot actions \(2, 5, 4\), .* OneHotCategorical"
INDEX = SEEN + r"integer indices \(2, 5\) or \(2, 5, 1\), .* Categorical"


@pytest.mark.losses("discrete", "discrete-idm")
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
    family, family_batch, name, one_hot, action, expected
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    loss = family(name, family.networks(name, **kwargs))
    batch = family_batch(name, 2, 5)
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


@pytest.mark.losses(having="critics")
def test_critics_that_write_another_entry_are_named(family, family_batch, name) -> None:
    networks = family.networks(name)
    (key,) = networks.critics[0].out_keys
    for critic in networks.critics:
        critic.out_keys = ["values"]
    with pytest.raises(KeyError, match=rf"write \['values'\], not '{key}'"):
        family(name, networks)(family_batch(name, 10))


def test_an_actor_that_writes_another_entry_is_named(
    family, family_batch, make_deterministic_actor
) -> None:
    networks = family.networks("td3bc")
    networks.actor = make_deterministic_actor("module", action="torque")
    with pytest.raises(KeyError, match=r"actor writes no 'action'.*set_keys\(action="):
        family("td3bc", networks)(family_batch("td3bc", 10))


def test_an_action_that_would_be_read_as_a_state_is_named(family, family_batch) -> None:
    """As with nested keys of which ``set_keys`` was told nothing."""
    loss = family("td3bc")
    loss.set_keys(action="torque")
    batch = family_batch("td3bc", 4)
    batch["torque"] = batch["action"]
    batch["next", "action"] = batch["action"]
    with pytest.raises(KeyError, match="'action' is what the actor writes"):
        loss(batch)
