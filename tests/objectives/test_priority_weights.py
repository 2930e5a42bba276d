"""Weighted means: any weights, masks and ended rows, against plain sums over the rows.

An entry is one term a loss or two: the recovery term counts rows with a next state
only. A mean over no row, or over weights of 0, is 0 and trains nothing.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_settings import tried
from tensordict import TensorDict
from torch import Tensor

ROWS = 5
OF_TRANSITIONS = ("recovery", "loss_inverse_dynamics")


def weighted_mean(rows: Tensor, counted: Tensor) -> Tensor:
    """sum(rows * counted) / sum(counted), or 0 over no weight."""
    total = counted.sum()
    return (rows * counted).sum() / total if total else total


def counts(batch: TensorDict, weight: Tensor, key: str) -> Tensor:
    """What each row counts for in a term, ``[B]``."""
    mask = batch.get(("collector", "mask"), torch.ones(len(batch), 1).bool())
    ended = batch["next", "done"] & (key in OF_TRANSITIONS)
    return weight * (mask & ~ended).squeeze(-1)


@pytest.mark.losses(having="weights of rows")
@pytest.mark.parametrize("shape", [(10,), (10, 1)])
def test_rows_weigh_as_much_as_their_priority_weight(
    family, family_batch, seeded, terms, name, shape
) -> None:
    batch = family_batch(name, 10)
    plain = seeded(family(name), batch)
    rows = terms(name, family(name, reduction="none"), batch)
    weight = torch.rand(10, dtype=torch.float64) + 0.1
    batch["priority_weight"] = weight.reshape(shape)
    found = {
        reduction: terms(name, family(name, reduction=reduction), batch)
        for reduction in ("mean", "sum", "none")
    }
    for key, each in rows.items():
        counted = counts(batch, weight, key)
        mean = weighted_mean(each, counted)
        torch.testing.assert_close(found["mean"][key], mean)
        torch.testing.assert_close(found["sum"][key], (each * counted).sum())
        torch.testing.assert_close(found["none"][key], each * counted)
    # Metrics are not weighted, and weights are not used where nobody wants them.
    weighed = seeded(family(name), batch)
    ignoring = seeded(family(name, use_prioritized_weights=False), batch)
    for key in family[name].metrics:
        assert torch.equal(weighed[key], plain[key])
    for key, value in plain.items():
        assert torch.equal(ignoring[key], value)


flags = st.lists(st.booleans(), min_size=ROWS, max_size=ROWS)
numbers = st.lists(
    st.one_of(st.just(0.0), st.floats(1e-3, 1e3)), min_size=ROWS, max_size=ROWS
)


@pytest.mark.losses("osr", "osrv", "recovery", "cloning", "discrete", "edac", "td3bc")
@given(numbers, st.one_of(st.none(), flags), flags, st.booleans())
@tried(8)
def test_no_weight_mask_or_end_spoils_a_value_or_a_gradient(
    family, family_batch, record, terms, name, weight, mask, done, column
) -> None:
    batch = family_batch(name, ROWS)
    ended = torch.tensor(done).unsqueeze(-1)
    batch["next", "done"] = ended
    batch["next", "terminated"] = ended & batch["next", "terminated"]
    # What a loader may leave as the next state of an ended row.
    batch["next", "observation"][batch["next", "terminated"].squeeze(-1)] = torch.nan
    if mask is not None:
        batch["collector", "mask"] = torch.tensor(mask).unsqueeze(-1)
    rows = terms(name, family(name, reduction="none"), batch)
    weight = torch.tensor(weight, dtype=torch.float64)
    batch["priority_weight"] = weight.unsqueeze(-1) if column else weight
    loss = family(name)
    for key, value in terms(name, loss, batch).items():
        expected = weighted_mean(rows[key], counts(batch, weight, key))
        torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-9)
    assert all(value.isfinite().all() for value in record(loss, batch))


@pytest.mark.losses
@pytest.mark.parametrize(
    "case", ["all done", "all masked", "weights on done rows", "weights of 0"]
)
def test_a_term_of_no_row_is_zero_and_trains_nothing(
    family, family_batch, seeded, terms, name, case
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    done = batch["next", "done"]
    if case == "all done":
        done[:] = True
    elif case == "all masked":
        batch["collector", "mask"] = torch.zeros_like(done)
    elif case == "weights on done rows":
        batch["priority_weight"] = done.squeeze(-1).double()
    else:
        batch["priority_weight"] = torch.zeros(10, dtype=torch.float64)
    weighs = family.has(name, "priority weight")
    for key, value in terms(name, loss, batch).items():
        gradients = torch.autograd.grad(
            value, list(loss.parameters()), allow_unused=True, retain_graph=True
        )
        found = [value, *(each for each in gradients if each is not None)]
        assert all(each.isfinite().all() for each in found)
        nothing = key in OF_TRANSITIONS if "done" in case else True
        if nothing and (weighs or "all" in case):
            assert all(not each.any() for each in found), key
    assert all(value.isfinite() for value in seeded(loss, batch).values())
