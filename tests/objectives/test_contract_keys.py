"""TorchRL's conventions about keys, one test each for every loss of the package."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, unravel_key

REDUCTIONS = ["mean", "sum", "none"]


def test_in_keys_are_stable_and_enough(
    family, family_batch, seeded, assert_same, name
) -> None:
    loss, batch = family(name), family_batch(name, 10, twin=True)
    assert loss.in_keys == family[name].in_keys
    everything, enough = seeded(loss, batch), batch.select(*loss.in_keys)
    out = seeded(loss, enough)
    keys = family[name].out_keys
    assert_same([out[key] for key in keys], [everything[key] for key in keys])
    assert loss.in_keys == family[name].in_keys


@pytest.mark.parametrize("reduction", [None, *REDUCTIONS])
def test_out_keys_are_what_forward_returns(
    family, family_batch, name, reduction
) -> None:
    loss, member = family(name, reduction=reduction), family[name]
    expected = list(member.groups) if reduction == "none" else member.out_keys
    assert loss.out_keys == expected
    assert list(loss(family_batch(name, 10)).keys()) == expected


def test_metrics_can_be_kept_where_nothing_is_reduced(
    family, family_batch, seeded, critic_loss
) -> None:
    batch, expected = family_batch(critic_loss, 10), family[critic_loss].out_keys
    loss = family(critic_loss, reduction="none", scalar_output_mode="non_tensor")
    out = seeded(loss, batch)
    assert set(out.keys()) == set(expected)
    assert loss.out_keys == expected
    mean = seeded(family(critic_loss), batch)
    for key in family[critic_loss].metrics:
        assert torch.equal(out[key], mean[key]), key


def test_reduction_none_warns_about_the_metrics_it_drops(family, critic_loss) -> None:
    with pytest.warns(UserWarning, match="leaves its scalar metrics out"):
        loss = family(critic_loss, reduction="none", scalar_output_mode=None)
    assert loss.out_keys == list(family[critic_loss].groups)


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
    for key in ("reward", "done", "terminated"):
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


@pytest.mark.parametrize("estimator", ["before", "after", "never"])
def test_value_estimator_follows_the_renamed_keys(
    family, family_batch, seeded, assert_same, critic_loss, estimator
) -> None:
    batch = weighted(family_batch(critic_loss, 10))
    other = renamed(batch)
    expected = seeded(family(critic_loss), batch)
    loss = renamed_loss(family, critic_loss, estimator)
    check_renamed(loss, other, expected, assert_same)
    assert torch.equal(other["agent", "priority"], batch["td_error"])


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


def test_losses_without_recovery_need_no_model_and_no_twin(
    family, family_batch, seeded, unrecovering
) -> None:
    expected = seeded(family(unrecovering), family_batch(unrecovering, 10, twin=True))
    networks = family.networks(unrecovering)
    networks.inverse_dynamics = None
    loss = family(unrecovering, networks)
    out = seeded(loss, family_batch(unrecovering, 10, twin=False))
    assert list(out.keys()) == list(expected.keys())
    assert all(
        torch.equal(out[key], expected[key]) for key in family[unrecovering].out_keys
    )


def test_losses_without_the_conservative_term_read_the_same(
    family, family_batch, conservative
) -> None:
    member = family[conservative]
    loss = family(conservative, min_q_weight=0.0, **NOT_LAGRANGE.get(conservative, {}))
    gone = ("loss_cql", "loss_alpha_prime", "alpha_prime")
    expected = [key for key in member.out_keys if key not in gone]
    assert loss.in_keys == member.in_keys
    assert list(loss(family_batch(conservative, 10)).keys()) == expected
    assert loss.out_keys == expected


# The multiplier has nothing to hold without the term.
NOT_LAGRANGE = {"cql-options": {"with_lagrange": False}}


@pytest.mark.parametrize(
    "model", ["recovery", "recovery-delta", "recovery-plain", "idm", "discrete-idm"]
)
def test_clean_states_need_no_twin(family, family_batch, seeded, model) -> None:
    loss = family(model, states="clean")
    assert all(key[0] != "perturbed" for key in loss.in_keys)
    with_twin, without = (
        seeded(loss, family_batch(model, 10, twin=twin)) for twin in (True, False)
    )
    assert all(torch.equal(with_twin[key], without[key]) for key in loss.out_keys)
