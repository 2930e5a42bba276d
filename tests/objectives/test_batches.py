"""What a loss does with a batch: types, shapes, masks, weights, ends and targets."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from objectives.losses import (
    LOSSES,
    NEXT,
    WITH_CRITICS,
    Networks,
    assert_same,
    assert_same_bits,
    call,
    every_loss,
    make_batch,
    make_loss,
    parts,
    record,
    with_critics,
)
from torchrl.data.postprocs import MultiStep

MASK = ("collector", "mask")


@every_loss
def test_flags_of_any_type_are_flags(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    batch[MASK] = torch.arange(10).unsqueeze(-1) != 3
    if name != "iql":
        batch["is_synthetic"] = torch.arange(10).unsqueeze(-1) > 6
    flags = [key for key, each in batch.items(True, True) if each.dtype == torch.bool]
    wanted = record(loss, batch)
    for dtype in (torch.uint8, torch.int64, torch.float32, torch.float64):
        other = batch.clone()
        for key in flags:
            other[key] = batch[key].to(dtype)
        assert_same_bits(record(loss, other), wanted)


@every_loss
def test_numbers_of_any_type_are_cast_to_the_networks(name) -> None:
    loss, batch = make_loss(name).float(), make_batch(name, 10)
    single = batch.apply(lambda x: x.float() if x.is_floating_point() else x)
    wanted = record(loss, single)
    assert_same_bits(record(loss, batch), wanted)
    assert {each.dtype for each in wanted} == {torch.float32}
    assert all(each.isfinite().all() for each in wanted)


def test_a_counter_is_not_the_type_of_a_network() -> None:
    networks, batch = Networks(), make_batch("osr", 10)
    wanted = record(make_loss("osr"), batch)
    networks.actor[0].module.register_buffer("count", torch.tensor(0))
    assert_same_bits(record(make_loss("osr", networks), batch), wanted)


@every_loss
def test_shape_of_the_batch_changes_no_number(name) -> None:
    loss, flat = make_loss(name), make_batch(name, 10)
    shaped = flat.reshape(2, 5)
    assert_same(record(loss, shaped), record(loss, flat))
    if name in WITH_CRITICS:
        assert torch.equal(shaped["td_error"], flat["td_error"].reshape(2, 5))
    row = flat[:1].clone()
    assert_same(record(loss, row[0]), record(loss, row))


@every_loss
def test_batch_is_unchanged_but_for_the_priority(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    batch["loc"] = torch.ones(10, 2)  # as an actor has written it in a collector
    batch["one_step"] = batch["next"].clone()
    batch["one_step", "done"] = batch["next", "done"].float()
    before = batch.clone()
    loss(batch)
    new = set(batch.keys(True, True)) - set(before.keys(True, True))
    assert new == ({"td_error"} if name in WITH_CRITICS else set())
    assert (batch.select(*before.keys(True, True)) == before).all()
    assert batch["one_step", "done"].dtype == torch.float32
    assert not any(value.requires_grad for value in batch.values(True, True))


@every_loss
@pytest.mark.parametrize("case", ["plain", "weights", "mask and weights"])
def test_reductions_are_of_the_same_rows(name, case) -> None:
    """Means count unmasked rows, by their weights; here no row has ended."""
    batch = make_batch(name, 2, 5, ends=False)
    counts = torch.ones(2, 5, dtype=torch.float64)
    if "mask" in case:
        batch[MASK] = (torch.arange(10).reshape(2, 5, 1) % 4) > 0
        counts = batch[MASK].squeeze(-1).double()
    plain = call(make_loss(name), batch)
    rows = call(make_loss(name, reduction="none"), batch)
    if "weights" in case:
        weight = torch.linspace(0.2, 2.0, 10).double().reshape(2, 5)
        batch["priority_weight"] = weight.unsqueeze(-1) if "mask" in case else weight
        counts = counts * weight
        ignoring = call(make_loss(name, use_prioritized_weights=False), batch)
        assert_same_bits([*ignoring.values()], [*plain.values()])
    found = {
        reduction: call(make_loss(name, reduction=reduction), batch)
        for reduction in ("mean", "sum", "none")
    }
    for key in LOSSES[name].trains:
        assert rows[key].shape == (2, 5)
        total = (rows[key] * counts).sum()
        torch.testing.assert_close(found["none"][key], rows[key] * counts)
        torch.testing.assert_close(found["sum"][key], total)
        torch.testing.assert_close(found["mean"][key], total / counts.sum())
    for key in set(plain.keys()) - set(LOSSES[name].trains):  # never weighted
        assert torch.equal(found["mean"][key], plain[key])
        assert torch.equal(found["sum"][key], plain[key])


@every_loss
@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_masked_rows_may_hold_anything(name, reduction) -> None:
    loss, batch = make_loss(name, reduction=reduction), make_batch(name, 2, 5)
    batch[MASK] = torch.arange(10).reshape(2, 5, 1) % 5 < 3
    wanted, padding = record(loss, batch), ~batch[MASK].squeeze(-1)
    for garbage in (math.nan, 0.97):
        spoiled = batch.clone()
        for key, value in spoiled.items(True, True):
            if value.is_floating_point():
                value[padding] = garbage
            elif key != MASK:
                value[padding] = value[padding].flip(-1) if value.ndim > 2 else 0
        found = record(loss, spoiled)
        assert not spoiled.get("td_error", torch.zeros(2, 5))[padding].any()
        assert_same(found, wanted)
        assert all(each.isfinite().all() for each in found)
    if reduction == "mean":  # without the mask the garbage shows
        with pytest.raises(AssertionError):
            assert_same(record(loss, spoiled.exclude("collector")), wanted)


@every_loss
def test_next_state_of_ended_rows_changes_no_bit(name) -> None:
    """A row that was cut has a next state for critics, and for them alone."""
    loss, batch = make_loss(name), make_batch(name, 10)
    wanted = record(loss, batch)
    flag = "terminated" if name in WITH_CRITICS else "done"
    for garbage in (math.nan, 1e6):
        spoiled = batch.clone()
        spoiled[NEXT][batch["next", flag].squeeze(-1)] = garbage
        assert_same_bits(record(loss, spoiled), wanted)


@pytest.mark.parametrize("name", ["recovery", "model", "noisy-cloning"])
def test_a_batch_of_ends_alone_gives_zeros(name) -> None:
    batch = make_batch(name, 5)
    batch["next", "done"][:] = True
    assert not any(each.any() for each in record(make_loss(name), batch))


# What a loss learns from the data's actions, or from where they led.
LOSS_ACTOR = ["osr", "discrete", "bc", "td3-bc", "rebrac"]
RECOVERY = ["official", "recovery", "recovery-module", "noisy-cloning"]
OF_DATA = dict.fromkeys(LOSS_ACTOR, "loss_actor") | {"osr-v": "recovery_gap"}
OF_DATA |= dict.fromkeys(RECOVERY, "loss_recovery") | {"osr-v-cql": "recovery_gap"}
OF_DATA |= dict.fromkeys(["discrete-cql", "cql"], "loss_cql")
OF_DATA["cql-options"] = "loss_alpha_prime"


@pytest.mark.parametrize(("name", "key"), OF_DATA.items())
def test_actions_of_synthetic_rows_are_not_imitated(name, key) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    batch["is_synthetic"] = torch.arange(10).unsqueeze(-1) >= 6
    other = batch.clone()
    for entry in ("action", NEXT):
        other[entry][6:] = batch[entry][:4]
    assert torch.equal(call(loss, other)[key], call(loss, batch)[key])
    for each in (batch, other):
        del each["is_synthetic"]
    assert not torch.equal(call(loss, other)[key], call(loss, batch)[key])


CONTINUOUS = [name for name in LOSSES if LOSSES[name].action == "continuous"]
READ = [name for name in CONTINUOUS if not name.startswith("recovery")]


@pytest.mark.parametrize("name", sorted({*READ} - {"iql", "fqe"}))  # without bounds
def test_actions_beyond_the_bounds_are_warned_about_once(name) -> None:
    networks, batch = Networks(high=torch.tensor([1.0, 0.5])), make_batch(name, 10)
    options = {"high": [1.0, 0.5]} if name in ("td3-bc", "rebrac") else {}
    batch["action"][:] = 0.2
    make_loss(name, networks, **options)(batch)
    loss = make_loss(name, networks, **options)
    batch["action"][4, 1] = 0.7
    with pytest.warns(UserWarning, match=r"leave the bounds .*\[1.0, 0.5\].*low="):
        loss(batch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(batch)
        networks, batch = Networks(low=0.1), make_batch(name, 10)
        options = {"low": [0.1] * 2, "high": [1.0] * 2} if options else {}
        batch["action"][:] = 0.2
        batch[MASK] = torch.arange(10) > 0  # this row becomes zeros
        make_loss(name, networks, **options)(batch)


@pytest.mark.parametrize("name", READ)
def test_actions_of_another_shape_are_named(name) -> None:
    """``[B]`` would broadcast where B is the number of dimensions."""
    loss, batch = make_loss(name), make_batch(name, 2)
    for shape in ((2,), (2, 1), (2, 3)):
        with pytest.raises(ValueError, match=r"'action' has shape \(2,"):
            loss(batch.clone().set("action", torch.zeros(shape)))


@with_critics
def test_target_follows_the_discount(name) -> None:
    loss, batch, found = make_loss(name), make_batch(name, 2, 5), []
    for gamma in (0.0, 0.5, 1.0):
        loss.make_value_estimator(gamma=gamma)
        found.append(call(loss, batch)["target_value"])
    zero, half, one = found
    torch.testing.assert_close(zero, batch["next", "reward"].mean())
    torch.testing.assert_close(half, (zero + one) / 2)
    with pytest.raises(NotImplementedError):
        loss.make_value_estimator("tdlambda")


@with_critics
def test_a_return_of_one_step_changes_nothing(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 2, 5)
    assert_same(record(loss, MultiStep(0.875, 1)(batch.clone())), record(loss, batch))


# Those that read the next state as the one an action leads to, and the term that does.
SINGLE = {"osr": "recovery_kl", "osr-v": "recovery_gap", "discrete": "recovery_kl"}
SINGLE |= {"recovery": "loss_recovery", "official": "loss_recovery"}
SINGLE |= {"model": "loss_inverse_dynamics"}


@pytest.mark.parametrize(("name", "key"), SINGLE.items())
def test_models_read_single_steps_kept_beside_those_of_several(name, key) -> None:
    single = make_batch(name, 30, ends=False)
    several = single.clone().set("next", single["next"].roll(1, 0))
    several["steps_to_next_obs"] = torch.full((30, 1), 2)
    several["next", "done"][:9] = True
    loss = make_loss(name)
    refused = r"multi-step .*\(2 steps\).*leave MultiStep out"
    with pytest.raises(ValueError, match=refused):
        loss(several)
    both = several.clone().set("one_step", single["next"])
    assert torch.equal(call(loss, both)[key], call(loss, single)[key])
    if name in WITH_CRITICS:
        parts(loss)[0].make_value_estimator(gamma=0.5)
        found = call(loss, both)["target_value"]
        parts(loss)[0].make_value_estimator(gamma=0.25)
        several["steps_to_next_obs"].fill_(1)
        torch.testing.assert_close(found, call(loss, several)["target_value"])
