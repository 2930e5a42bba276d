"""Fused critics: the numbers of the modules, and which critics are fused."""

from __future__ import annotations

import copy
from functools import partial

import pytest
import torch
from objectives.losses import (
    A,
    Networks,
    S,
    assert_same,
    call,
    make_batch,
    make_loss,
    parts,
    record,
)
from torch import nn
from torchrl.modules import MLP, ValueOperator

from torchrl_osr.fast import critics as fused
from torchrl_osr.fast import fuse_critics

CELLS = [8, 6, 4]
KEYS = ("action", "state_action_value")


def normalised(norm_class: type[nn.Module] = nn.LayerNorm, **options):
    """Return options of a critic that normalises each hidden layer."""
    each = [{"normalized_shape": width} | options for width in CELLS]
    return {"norm_class": norm_class, "norm_kwargs": each}


def critic(*, in_keys=("observation", "action"), size: int = S + A, **options):
    """Return a critic of three hidden layers; with ReLUs unless told otherwise."""
    options = {"num_cells": CELLS, "activation_class": nn.ReLU} | options
    network = MLP(size, 1, **options)
    for layer in network:
        if isinstance(layer, nn.LayerNorm) and layer.bias is not None:
            nn.init.normal_(layer.weight)
            nn.init.normal_(layer.bias)
    return ValueOperator(network, list(in_keys), ["state_action_value"]).double()


# An eps that is not the default, and large enough to count.
KINDS = {"linear": {}, "normalised": normalised(eps=1e-2), "one": {"num_cells": [7]}}
each_kind = pytest.mark.parametrize("kind", KINDS)


def make_pair(name: str, chunk_size: int = 3, options=None, **critics):
    """Return a loss as it is and one of equal weights with fused critics."""
    networks = Networks()
    networks.critics = [critic(**critics) for _ in range(2)]
    plain, fast = (
        make_loss(name, copy.deepcopy(networks), **(options or {})) for _ in range(2)
    )
    fuse_critics(fast)
    for part in parts(fast):
        part.critics.chunk_size = chunk_size
    return plain, fast


def marked(batch, *marks: str):
    row = torch.arange(10).reshape(batch.batch_size)
    if "mask" in marks:
        batch["collector", "mask"] = row % 4 > 0
    if "weights" in marks:
        batch["priority_weight"] = 0.5 + 0.1 * row.double()
    return batch


CASES = {  # chunk size, reduction, marks of rows
    "large chunks": (64, "mean", []),
    "a sum": (3, "sum", ["mask"]),
    "rows": (1, "none", ["mask", "weights"]),
    "weights": (3, "mean", ["weights"]),
}


@pytest.mark.parametrize("name", ["cql", "cql-options", "osr", "official"])
@pytest.mark.parametrize("case", CASES)
@each_kind
def test_losses_and_gradients_are_those_of_the_modules(name, case, kind) -> None:
    chunk_size, reduction, marks = CASES[case]
    plain, fast = make_pair(name, chunk_size, {"reduction": reduction}, **KINDS[kind])
    batch = marked(make_batch(name, 2, 5), *marks)
    assert_same(record(fast, batch), record(plain, batch))


@pytest.mark.parametrize("name", ["osr-v-logsumexp", "rorl", "iql", "edac", "td3-bc"])
@each_kind
def test_values_are_those_of_the_modules(name, kind) -> None:
    plain, fast = make_pair(name, **KINDS[kind])
    batch = make_batch(name, 10)
    assert_same(record(fast, batch), record(plain, batch))


def test_critics_of_several_observations_and_frozen_layers_and_clipped_gaps() -> None:
    keys = {"in_keys": ["goal", "observation", "action"], "size": 2 * S + A}
    plain, fast = make_pair("cql", 3, {"clip_diff_min": 3.5}, **keys)
    batch = make_batch("cql", 10)
    for group in (batch, batch["next"]):
        group["goal"] = 0.5 * group["observation"]
    for loss in (plain, fast):
        frozen = loss.qvalue_network_params["module", "2", "weight"]
        frozen.requires_grad_(False)
    assert_same(record(fast, batch), record(plain, batch))


@pytest.fixture
def scored(monkeypatch) -> list[int]:
    """Return a list that grows by the rows of every pass of a fused critic."""
    counted: list[int] = []
    forward, qvalue = fused._forward, fused.qvalue

    def counting_forward(chunk, *rest):
        counted.append(len(chunk.action))
        return forward(chunk, *rest)

    def counting_qvalue(params, mlp, state, action):
        counted.append(2 * action.shape[:-1].numel())
        return qvalue(params, mlp, state, action)

    monkeypatch.setattr(fused, "_forward", counting_forward)
    monkeypatch.setattr(fused, "qvalue", counting_qvalue)
    return counted


# 2 critics and K = 10: 33 actions a state, 30 of them sampled. Where rows differ in
# weight the sampled ones are computed once more.
@pytest.mark.parametrize(("marks", "rows"), [([], 66), (["weights"], 66 + 60)])
def test_no_row_is_scored_twice_where_all_weigh_the_same(scored, marks, rows) -> None:
    batch = marked(make_batch("cql", 10), *marks)
    plain, fast = make_pair("cql", 3, {"num_random": 10})
    plain(batch)
    assert not scored, "only after fuse_critics"
    out = fast(batch)
    sum(out[key] for key in fast.out_keys if key.startswith("loss_")).backward()
    assert sum(scored) == 10 * rows
    # Nothing in chunks where nothing is differentiated, or the states are.
    scored.clear()
    with torch.no_grad():
        fast(batch)
    batch["observation"].requires_grad_()
    fast(batch)["loss_cql"].backward()
    assert batch["observation"].grad.abs().sum() > 0
    assert len(scored) == 2 * 3


def test_a_loss_follows_a_hook_and_a_change_of_its_critics(scored) -> None:
    (_, loss), batch, calls = make_pair("cql"), make_batch("cql", 10), []
    plain = call(loss, batch)["loss_cql"]
    assert scored
    scored.clear()
    first = loss.qvalue_network.module[0]
    handle = first.register_forward_hook(lambda *_: calls.append(1))
    torch.testing.assert_close(call(loss, batch)["loss_cql"], plain)
    handle.remove()
    loss.qvalue_network.module[-2] = nn.Tanh()
    assert not torch.isclose(call(loss, batch)["loss_cql"], plain)
    assert calls
    assert not scored


def test_second_derivatives_are_refused() -> None:
    _, loss = make_pair("cql")
    critics, value = loss.qvalue_network_params, loss(make_batch("cql", 10))["loss_cql"]
    with pytest.raises(RuntimeError, match="once_differentiable"):
        torch.autograd.grad(value, [*critics.parameters()], create_graph=True)


@each_kind
def test_under_autocast_values_and_gradients_are_close(kind) -> None:
    plain, fast = make_pair("cql", **KINDS[kind])
    batch, exact = make_batch("cql", 128), record(plain.float(), make_batch("cql", 128))
    with torch.autocast("cpu", torch.bfloat16):
        half = record(fast.float(), batch)
    found, wanted = (torch.cat([t.flatten() for t in each]) for each in (half, exact))
    assert found.dtype == torch.float32
    assert not torch.equal(found, wanted), "nothing was computed in half precision"
    assert (found - wanted).norm() < 2e-2 * wanted.norm()


class Scaled(ValueOperator):
    def forward(self, tensordict):
        out = super().forward(tensordict)
        return out.set("state_action_value", 10 * out["state_action_value"])


def changed(change, **options):
    network = critic(**options)
    change(network)
    return network


OTHERS = {
    "activation": partial(critic, activation_class=nn.Tanh),
    "activation at the end": partial(critic, activate_last_layer=True),
    "no shift": partial(critic, **normalised(bias=False)),
    "other norms": partial(critic, **normalised(nn.RMSNorm)),
    "dropout": partial(critic, dropout=0.5),
    "no bias": partial(critic, bias_last_layer=False),
    "the action first": partial(critic, in_keys=("action", "observation")),
    "class": partial(changed, lambda it: setattr(it, "__class__", Scaled)),
    "hook": partial(changed, lambda it: it.register_forward_hook(lambda *_: None)),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_critics_go_as_modules(kind) -> None:
    assert fused.plain_mlp(OTHERS[kind](), *KEYS) is None
