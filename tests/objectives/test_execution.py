"""The same numbers with and without vmap, torch.compile and autocast; rows scored."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import (
    LOSSES,
    WITH_CRITICS,
    assert_same,
    call,
    make_batch,
    make_loss,
    make_networks,
    record,
)
from torch._dynamo.exc import InternalTorchDynamoError


@pytest.mark.parametrize("name", WITH_CRITICS)
def test_a_loop_over_critics_equals_vmap(name) -> None:
    batch = make_batch(name, 10)
    for number in (2, 3):
        looped, mapped = (
            make_loss(name, make_networks(name, number=number), deactivate_vmap=loop)
            for loop in (True, False)
        )
        assert_same(record(looped, batch), record(mapped, batch))


# One loss for each path that is traced, for tracing takes seconds. torch 2.13,
# tensordict 0.14.3 and TorchRL 0.14.1 warn of each other while they are traced, and not
# at every time of the same things.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["osr", "iql", "discrete"])
def test_compiled_loss_equals_eager_without_graph_breaks(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    eager = record(loss, batch)
    torch.compiler.reset()
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    try:
        traced = record(compiled, batch)
    except InternalTorchDynamoError as error:
        # Its message quotes our line; hundreds of frames of the tracer do not.
        pytest.fail(str(error), pytrace=False)
    assert_same(traced, eager)


@pytest.mark.parametrize("name", LOSSES)
def test_under_autocast_every_output_is_float32_and_close(name) -> None:
    loss, batch = make_loss(name).float(), make_batch(name, 64)
    wanted = call(loss, batch)
    with torch.autocast("cpu", torch.bfloat16):
        found = call(loss, batch)
    losses = LOSSES[name].trains
    for key, value in found.items():
        assert value.dtype == torch.float32, key
        # Eight bits of mantissa; the Lagrangian's terms are small differences.
        if key in losses:
            torch.testing.assert_close(value, wanted[key], rtol=0.1, atol=2e-2)
    assert not all(torch.equal(found[key], wanted[key]) for key in losses)
    total = sum(found[key] for key in losses)
    for slope in torch.autograd.grad(total, [*loss.parameters()]):
        assert slope.dtype == torch.float32
        assert slope.isfinite().all()
