"""TorchRL's conventions about keys, one test each for every loss of the package."""

from __future__ import annotations

import inspect

import pytest
import torch
from tensordict import TensorDict, unravel_key

from torchrl_osr.lab.losses import EDACLoss

REDUCTIONS = ["mean", "sum", "none"]


@pytest.mark.losses
def test_in_keys_are_stable_and_enough(
    family, family_batch, seeded, assert_same, name
) -> None:
    loss, batch = family(name), family_batch(name, 10, perturbed=True)
    assert loss.in_keys == family[name].in_keys
    everything, enough = seeded(loss, batch), batch.select(*loss.in_keys)
    out = seeded(loss, enough)
    keys = family[name].out_keys
    assert_same([out[key] for key in keys], [everything[key] for key in keys])
    assert loss.in_keys == family[name].in_keys


@pytest.mark.losses
@pytest.mark.parametrize("reduction", [None, *REDUCTIONS])
def test_out_keys_are_what_forward_returns(
    family, family_batch, name, reduction
) -> None:
    loss, member = family(name, reduction=reduction), family[name]
    expected = list(member.groups) if reduction == "none" else member.out_keys
    assert loss.out_keys == expected
    assert list(loss(family_batch(name, 10)).keys()) == expected


@pytest.mark.losses(having="critics")
def test_metrics_can_be_kept_where_nothing_is_reduced(
    family, family_batch, seeded, name
) -> None:
    batch, expected = family_batch(name, 10), family[name].out_keys
    loss = family(name, reduction="none", scalar_output_mode="non_tensor")
    out = seeded(loss, batch)
    assert set(out.keys()) == set(expected)
    assert loss.out_keys == expected
    mean = seeded(family(name), batch)
    for key in family[name].metrics:
        assert torch.equal(out[key], mean[key]), key


@pytest.mark.losses(having="critics")
def test_reduction_none_warns_about_the_metrics_it_drops(family, name) -> None:
    networks, member = family.networks(name), family[name]
    parts = [getattr(networks, part) for part in member.parts]
    line = inspect.currentframe().f_lineno + 2
    with pytest.warns(UserWarning, match="leaves its scalar metrics out") as caught:
        loss = member.loss_class(*parts, **member.options, reduction="none")
    assert loss.out_keys == list(member.groups)
    assert [(each.filename, each.lineno) for each in caught] == [(__file__, line)]


def test_a_derived_loss_warns_of_its_own_line(make_networks) -> None:
    class Derived(EDACLoss):
        def __init__(self, *networks) -> None:
            super().__init__(*networks, reduction="none")

    networks = make_networks()
    with pytest.warns(UserWarning, match="Derived with reduction='none'") as caught:
        Derived(networks.actor, networks.critics)
    line = Derived.__init__.__code__.co_firstlineno + 1
    assert [(each.filename, each.lineno) for each in caught] == [(__file__, line)]


@pytest.mark.losses
def test_keys_have_defaults_can_be_renamed_and_restored(family, name) -> None:
    loss, member = family(name), family[name]
    assert vars(loss.tensor_keys) == member.keys
    for key, default in member.keys.items():
        loss.set_keys(**{key: ("group", "renamed")})
        assert getattr(loss.tensor_keys, key) == ("group", "renamed")
        loss.set_keys(**{key: None})
        assert getattr(loss.tensor_keys, key) == default
    assert loss.in_keys == member.in_keys
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(unknown="renamed")


STATE = ("agent", "observation")
RENAMED = {
    "action": ("agent", "action"),
    "state_action_value": ("agent", "value"),
    "action_value": ("agent", "values"),
    "value": ("agent", "state_value"),
    "perturbed": "noisy",
    "reward": ("agent", "reward"),
    "done": ("agent", "done"),
    "terminated": "over",
    "priority": ("agent", "priority"),
    "priority_weight": ("agent", "weight"),
}


def below(prefix: str, key):
    return unravel_key((prefix, key))


def renamed(batch: TensorDict) -> TensorDict:
    """The same numbers under other names, most of them nested."""
    names = {
        "observation": STATE,
        "action": RENAMED["action"],
        "priority_weight": RENAMED["priority_weight"],
        ("next", "observation"): below("next", STATE),
        ("perturbed", "observation"): below("noisy", STATE),
    }
    for key in ("action", "reward", "done", "terminated"):
        names["next", key] = below("next", RENAMED[key])
    found = TensorDict({}, batch.batch_size)
    for key, value in batch.items(True, True):
        found[names[key]] = value
    return found


def renamed_loss(family, name: str, estimator: str):
    """A loss of renamed keys, its value estimator made before or after that."""
    action = RENAMED["action"]
    networks = family.networks(name, observation=STATE, action=action)
    for critic in networks.critics:
        critic.out_keys = [RENAMED[critic.out_keys[-1]]]
    loss, member = family(name, networks), family[name]
    if estimator == "before":
        loss.make_value_estimator(gamma=0.99)
    loss.set_keys(**{key: RENAMED[key] for key in member.keys})
    if estimator == "after":
        loss.make_value_estimator(gamma=0.99)
    return loss


def check_renamed(loss, batch, expected, assert_same) -> None:
    torch.manual_seed(2)
    out = loss(batch)
    keys = loss.out_keys
    assert_same([out[key] for key in keys], [expected[key] for key in keys])


def weighted(batch: TensorDict) -> TensorDict:
    batch["priority_weight"] = torch.linspace(0.5, 2.0, len(batch)).double()
    return batch


@pytest.mark.losses
def test_nested_and_renamed_keys_give_the_same_numbers(
    family, family_batch, seeded, assert_same, name
) -> None:
    batch = weighted(family_batch(name, 10))
    expected, loss = (
        seeded(family(name), batch.copy()),
        renamed_loss(family, name, "never"),
    )
    enough = renamed(batch).select(*loss.in_keys, RENAMED["priority_weight"])
    check_renamed(loss, enough, expected, assert_same)


@pytest.mark.losses(having="critics")
@pytest.mark.parametrize("estimator", ["before", "after"])
def test_value_estimator_follows_the_renamed_keys(
    family, family_batch, seeded, assert_same, name, estimator
) -> None:
    batch = weighted(family_batch(name, 10))
    other = renamed(batch)
    expected = seeded(family(name), batch)
    loss = renamed_loss(family, name, estimator)
    check_renamed(loss, other, expected, assert_same)
    assert torch.equal(other["agent", "priority"], batch["td_error"])


@pytest.mark.losses
@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_keyword_call_equals_tensordict_call(
    family, family_batch, seeded, assert_same, name, reduction
) -> None:
    loss, batch = family(name, reduction=reduction), family_batch(name, 10)
    inputs = {
        key if isinstance(key, str) else "_".join(key): batch[key]
        for key in loss.in_keys
    }
    expected = seeded(loss, batch)
    found = seeded(loss, **inputs)
    found = found if isinstance(found, tuple) else (found,)
    assert_same(found, [expected[key] for key in loss.out_keys])


def test_nested_keywords_are_joined(family, family_batch, seeded, assert_same) -> None:
    batch = renamed(family_batch("osr", 10))
    loss = renamed_loss(family, "osr", "never")
    names = [key if isinstance(key, str) else "_".join(key) for key in loss.in_keys]
    values = map(batch.get, loss.in_keys)
    expected = seeded(loss, batch.copy())
    assert_same(
        seeded(loss, **dict(zip(names, values, strict=True))), expected.values()
    )


@pytest.mark.losses
def test_selected_out_keys_are_all_that_comes_back(
    family, family_batch, seeded, assert_same, name
) -> None:
    loss, batch, losses = family(name), family_batch(name, 10), family[name].groups
    expected = seeded(loss, batch)
    selected = dict.fromkeys([next(iter(losses)), list(losses)[-1]])
    loss.select_out_keys(*selected)
    out = seeded(loss, batch)
    assert set(out.keys()) == set(selected)
    assert_same([out[key] for key in selected], [expected[key] for key in selected])
    loss.reset_out_keys()
    assert loss.out_keys == family[name].out_keys
    assert set(seeded(loss, batch).keys()) == set(loss.out_keys)


NO_MODEL = ["cql", "cql-perturbed", "cql-options", "discrete-cql"]
NO_MODEL += ["cloning", "noisy-cloning"]


@pytest.mark.losses(*NO_MODEL)
def test_losses_without_the_model_are_built_without_it(
    family, family_batch, seeded, assert_same_bits, name
) -> None:
    batch, networks = family_batch(name, 10), family.networks(name)
    expected = seeded(family(name), batch)
    networks.inverse_dynamics = None
    out = seeded(family(name, networks), batch)
    assert list(out.keys()) == list(expected.keys())
    assert_same_bits(list(out.values()), list(expected.values()))


@pytest.mark.losses(having="cql")
def test_losses_without_the_conservative_term_read_the_same(
    family, family_batch, name
) -> None:
    member = family[name]
    loss = family(name, min_q_weight=0.0, **NOT_LAGRANGE.get(name, {}))
    gone = ("loss_cql", "loss_alpha_prime", "alpha_prime")
    expected = [key for key in member.out_keys if key not in gone]
    assert loss.in_keys == member.in_keys
    assert list(loss(family_batch(name, 10)).keys()) == expected
    assert loss.out_keys == expected


# The multiplier has nothing to hold without the term.
NOT_LAGRANGE = {"cql-options": {"with_lagrange": False}}


@pytest.mark.losses(
    "recovery", "recovery-delta", "recovery-plain", "idm", "discrete-idm"
)
def test_clean_states_need_no_perturbed_ones(
    family, family_batch, seeded, assert_same_bits, name
) -> None:
    option = "recovery_states" if name.startswith("recovery") else "states"
    loss = family(name, **{option: "clean"})
    assert all(key[0] != "perturbed" for key in loss.in_keys)
    found, expected = (
        seeded(loss, family_batch(name, 10, perturbed=perturbed))
        for perturbed in (True, False)
    )
    assert_same_bits(list(found.values()), list(expected.values()))
