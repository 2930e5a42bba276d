"""What a loss does with its batch: reductions, masks, weights, what it leaves alone."""

from __future__ import annotations

import copy

import pytest
import torch

REDUCTIONS = ["mean", "sum", "none"]
# Rows without a next state count neither in the sum nor in the number of rows.
OF_TRANSITIONS = ("recovery", "loss_inverse_dynamics")


def flag(batch, key: str) -> torch.Tensor:
    return batch["next", key].squeeze(-1)


@pytest.mark.losses(having="rows that count alike")
@pytest.mark.parametrize("size", [(10,), (2, 5)])
def test_reductions_agree(family, family_batch, seeded, terms, name, size) -> None:
    batch = family_batch(name, *size)
    losses = {key: family(name, reduction=key) for key in REDUCTIONS}
    found = {key: terms(name, loss, batch) for key, loss in losses.items()}
    for key, each in found["none"].items():
        done = flag(batch, "done") & (key in OF_TRANSITIONS)
        assert each.shape == size
        torch.testing.assert_close(each[done], torch.zeros_like(each[done]))
        torch.testing.assert_close(found["sum"][key], each.sum())
        torch.testing.assert_close(found["mean"][key], each.sum() / (~done).sum())
    out = {key: seeded(losses[key], batch) for key in REDUCTIONS}
    assert out["none"].batch_size == batch.batch_size
    for key in family[name].metrics:
        assert torch.equal(out["sum"][key], out["mean"][key])


@pytest.mark.losses(having="recovery")
def test_metric_is_the_unweighted_recovery_term(
    family, family_batch, seeded, terms, name
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    metric = seeded(loss, batch)[family[name].recovery_metric]
    assert not metric.requires_grad
    term = terms(name, loss, batch)["recovery"].detach()
    torch.testing.assert_close(term, 0.5 * metric)


@pytest.mark.losses
def test_time_dimension_changes_no_number(
    family, family_batch, seeded, assert_same, name
) -> None:
    # The same rows, [10] and [2, 5]: the draws have the same count and order.
    flat = family_batch(name, 10)
    shaped = flat.reshape(2, 5)
    expected, out = seeded(family(name), flat), seeded(family(name), shaped)
    assert_same([out[key] for key in expected.keys()], expected.values())  # noqa: SIM118
    if "td_error" in flat.keys():  # noqa: SIM118
        assert torch.equal(shaped["td_error"], flat["td_error"].reshape(2, 5))


def other_action(action: torch.Tensor) -> torch.Tensor:
    """Actions that nobody took: out at the border, or another one of the discrete."""
    if action.is_floating_point():
        return torch.full_like(action, 0.99)
    # A one-hot vector moves by an action, and so does an index.
    return action.roll(1, -1) if action.ndim > 2 else (action + 1) % 4


def spoil(batch, rows: torch.Tensor):
    """The batch with garbage in some rows."""
    spoiled = batch.clone()
    for key in ("observation", ("next", "observation"), ("perturbed", "observation")):
        if key in batch.keys(True):
            spoiled[key][rows] = 30.0
    spoiled["action"][rows] = other_action(batch["action"])[rows]
    spoiled["next", "reward"][rows] = -1e6
    spoiled["next", "done"][rows] = False
    return spoiled


@pytest.mark.losses
@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_padding_changes_neither_losses_nor_gradients(
    family, family_batch, record, assert_same, name, reduction
) -> None:
    loss, batch = family(name, reduction=reduction), family_batch(name, 2, 5)
    mask = torch.ones(2, 5, 1, dtype=torch.bool)
    mask[:, 3:] = False
    batch["collector", "mask"] = mask
    spoiled = spoil(batch, ~mask.squeeze(-1))
    wanted = record(loss, batch)
    assert_same(record(loss, spoiled), wanted)
    # Without the mask the same garbage does show.
    del spoiled["collector"]
    with pytest.raises(AssertionError):
        assert_same(record(loss, spoiled), wanted)


@pytest.mark.losses(having="rows that count alike")
def test_mean_is_over_unmasked_rows(family, family_batch, terms, name) -> None:
    batch = family_batch(name, 10)
    valid = torch.arange(10) < 6
    batch["collector", "mask"] = valid.unsqueeze(-1)
    rows = terms(name, family(name, reduction="none"), batch)
    for key, mean in terms(name, family(name), batch).items():
        counted = valid & ~flag(batch, "done") if key in OF_TRANSITIONS else valid
        torch.testing.assert_close(mean, rows[key][counted].mean())


@pytest.mark.losses
def test_batch_is_unchanged_but_for_the_priority(family, family_batch, name) -> None:
    loss, batch = family(name), family_batch(name, 10)
    # A batch straight from a buffer may carry what the networks write.
    batch["loc"] = torch.ones(10, 2)
    before = batch.clone()
    loss(batch)
    new = set(batch.keys(True, True)) - set(before.keys(True, True))
    assert new == ({"td_error"} if family.has(name, "critics") else set())
    assert (batch.select(*before.keys(True, True)) == before).all()
    for key, value in batch.items(True, True):
        assert not value.requires_grad, key


@pytest.mark.losses
def test_copies_compute_the_same_and_train_apart(
    family, family_batch, record, assert_same_bits, name
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    wanted = record(loss, batch)
    copied = copy.deepcopy(loss)
    assert_same_bits(record(copied, batch), wanted)
    for parameter in copied.parameters():
        parameter.data.add_(1.0)
    assert_same_bits(record(loss, batch), wanted)


@pytest.mark.losses
def test_losses_have_the_batch_dtype(family, family_batch, record, name) -> None:
    loss = family(name).float()  # the family is of float64
    batch = family_batch(name, 10)
    batch = batch.apply(lambda t: t.float() if t.is_floating_point() else t)
    for value in record(loss, batch):
        assert value.dtype == torch.float32
        assert value.isfinite().all()
