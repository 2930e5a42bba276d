"""Entries that a loss reads and writes, by any names, and errors about them."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import (
    LOSSES,
    NEXT,
    PERTURBED,
    WITH_CRITICS,
    assert_same,
    assert_same_bits,
    call,
    every_base,
    every_loss,
    make_batch,
    make_loss,
    make_networks,
    record,
)
from tensordict import TensorDict, unravel_key

ENDS = [("next", key) for key in ("reward", "done", "terminated")]
READS = {
    "cql": ["observation", "action", NEXT, *ENDS],
    "osr": ["observation", "action", NEXT, *ENDS, PERTURBED],
    "official": ["observation", "action", NEXT, *ENDS, PERTURBED],
    "rebrac": ["observation", "action", NEXT, *ENDS, ("next", "action")],
    "recovery": ["observation", NEXT, ("next", "done"), PERTURBED],
    "noisy-cloning": ["observation", "action", ("next", "done"), PERTURBED],
    "model": ["observation", NEXT, "action", ("next", "done"), PERTURBED],
    "bc": ["observation", "action"],
}


@every_loss
def test_in_and_out_keys_are_fixed_and_enough(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    wanted, keys = call(loss, batch), list(loss.in_keys)
    assert name not in READS or keys == READS[name]
    out = call(loss, batch.select(*keys))
    assert_same_bits([*out.values()], [*wanted.values()])
    assert loss.in_keys == keys
    losses = list(LOSSES[name].trains)
    for reduction in ("mean", "sum", "none"):
        loss = make_loss(name, reduction=reduction)
        assert list(loss(batch).keys()) == loss.out_keys
        assert [key for key in loss.out_keys if key.startswith("loss_")] == losses
        assert loss.out_keys[:1] == losses[:1]


STATE = ("agent", "observation")
RENAMED = {"perturbed": "noisy", "terminated": "over"} | {
    name: ("agent", f"its_{name}")
    for name in (
        *("action", "state_action_value", "action_value", "value", "reward"),
        *("done", "priority", "priority_weight", "is_synthetic", "steps_to_next_obs"),
    )
}


def renamed(batch: TensorDict) -> TensorDict:
    """Return the same numbers under other names, most of them nested."""
    found = TensorDict({}, batch.batch_size)
    for key, value in batch.items(True, True):
        *group, last = key if isinstance(key, tuple) else (key,)
        group = [RENAMED.get(each, each) for each in group]
        name = STATE if last == "observation" else RENAMED[last]
        found[unravel_key((*group, name))] = value
    return found


def renamed_loss(name: str):
    networks = make_networks(name, observation=STATE, action=RENAMED["action"])
    for critic in (*networks.critics, *networks.choice_critics):
        critic.out_keys = [RENAMED[critic.out_keys[-1]]]
    networks.value.out_keys = [RENAMED["value"]]
    loss = make_loss(name, networks)
    keys = vars(loss.tensor_keys)
    loss.set_keys(**{key: new for key, new in RENAMED.items() if key in keys})
    return loss


@every_base
def test_nested_and_renamed_keys_change_no_number(name) -> None:
    batch = make_batch(name, 10)
    batch["priority_weight"] = torch.linspace(0.5, 2.0, 10).double()
    if name in ("cql", "iql"):
        batch["steps_to_next_obs"] = torch.arange(1, 11).unsqueeze(-1)
    if name != "iql":
        batch["is_synthetic"] = torch.arange(10).unsqueeze(-1) > 6
    other, plain, loss = renamed(batch), make_loss(name), renamed_loss(name)
    assert_same(record(loss, other), record(plain, batch))
    if name in WITH_CRITICS:
        assert torch.equal(other[RENAMED["priority"]], batch["td_error"])
        for each in (plain, loss):
            each.make_value_estimator(gamma=0.8)
        assert_same(record(loss, other), record(plain, batch))
    loss.set_keys(**dict.fromkeys(vars(loss.tensor_keys)))
    assert loss.tensor_keys == plain.tensor_keys
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(unknown="renamed")


@every_base
def test_keyword_call_and_selected_keys(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    expected, written = call(loss, batch), list(loss.out_keys)
    names = ["_".join([key] if isinstance(key, str) else key) for key in loss.in_keys]
    torch.manual_seed(2)
    found = loss(**dict(zip(names, map(batch.get, loss.in_keys), strict=True)))
    found = found if isinstance(found, tuple) else (found,)
    assert_same(found, [expected[key] for key in written])
    loss.select_out_keys(written[0])
    out = call(loss, batch)
    assert list(out.keys()) == written[:1]
    assert torch.equal(out[written[0]], expected[written[0]])
    loss.reset_out_keys()
    assert list(call(loss, batch).keys()) == written


SHAPES = {NEXT: (10, 1), PERTURBED: (10, 4), ("next", "reward"): (10,)}
SHAPES |= {("next", "done"): (10,), ("next", "terminated"): (10, 2)}


@every_loss
def test_missing_entries_and_those_of_another_shape_are_named(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    for key in loss.in_keys:
        named = key if isinstance(key, str) else key[1]
        if key != ("next", "done"):  # which TD(0) can do without
            with pytest.raises(KeyError, match=named):
                loss(batch.exclude(key))
        if key in SHAPES:
            other = torch.zeros(SHAPES[key], dtype=batch[key].dtype)
            shape = ", ".join(map(str, SHAPES[key]))
            with pytest.raises(ValueError, match=rf"{named}.*\({shape}"):
                loss(batch.clone().set(key, other))
    if PERTURBED in loss.in_keys:
        with pytest.raises(KeyError, match="Append StatePerturbation"):
            loss(batch.exclude("perturbed"))
    with pytest.raises(ValueError, match="batch is empty .*at least one transition"):
        loss(make_batch(name, 4, 0))


def test_an_error_about_a_state_lists_the_whole_batch() -> None:
    batch = make_batch("cql", 4)
    batch["obs"] = batch.pop("observation")
    with pytest.raises(KeyError, match="no entry") as error:
        call(make_loss("cql"), batch)
    assert "'obs'" in error.value.args[0]
