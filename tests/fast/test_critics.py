"""Fused critics against their modules: losses, gradients, and who goes as modules."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, make_batch
from objectives.losses import make_loss as loss_of
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP, ValueOperator

from torchrl_osr import CQLLoss
from torchrl_osr.fast import critics, fuse_critics
from torchrl_osr.objectives.actor_critic import Critics

CELLS = [8, 6, 4]


def normalised(**options):
    """Options of a critic that normalises each hidden layer."""
    each = [{"normalized_shape": width} | options for width in CELLS]
    return {"norm_class": nn.LayerNorm, "norm_kwargs": each}


# An eps that is not the default, and large enough to count.
PLAIN = {"one layer": {"num_cells": [7]}, "normalised": normalised(eps=1e-2)}
CASES = [([7], {}), ([2, 5], {"temperature": 1.7})]
CASES += [([7], {"clip_diff_min": 0.0}), ([7], {"reduction": "sum"})]
OTHERS = {
    "tanh": {"activation_class": nn.Tanh},
    "no hidden layer": {"num_cells": []},
    "no bias": {"bias_last_layer": False},
    "no scale": normalised(elementwise_affine=False),
    "dropout": {"dropout": 0.1},
}


def critic(**options):
    options = {"num_cells": CELLS, "activation_class": nn.ReLU} | options
    network = MLP(5, 1, **options)
    for layer in network:
        if isinstance(layer, nn.LayerNorm) and layer.bias is not None:
            nn.init.normal_(layer.weight)
            nn.init.normal_(layer.bias)
    return ValueOperator(network, in_keys=["observation", "action"]).double()


def make_loss(name="cql", options=(), networks=None, **loss_options):
    parts = Networks()
    parts.critics = networks or [critic(**dict(options)) for _ in range(3)]
    return loss_of(name, parts, **loss_options)


def results(loss, batch: TensorDict) -> tuple[TensorDict, list]:
    torch.manual_seed(3)
    losses = loss(batch.clone())
    total = sum(value.square().sum() for key, value in losses.items() if "loss_" in key)
    params = [each for each in loss.parameters() if each.requires_grad]
    return losses.detach(), list(torch.autograd.grad(total, params))


def assert_fuses(loss, batch) -> None:
    """Compare the fused critics with the modules."""
    wanted = results(loss, batch)
    fuse_critics(loss)
    found = results(loss, batch)
    torch.testing.assert_close(dict(found[0]), dict(wanted[0]))
    torch.testing.assert_close(found[1], wanted[1])


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """Rows that went through the fused critics, call by call."""
    calls, original = [], critics._values

    def values(layers, eps, rows):
        calls.append(rows.shape[:-1].numel())
        return original(layers, eps, rows)

    monkeypatch.setattr(critics, "_values", values)
    return calls


@pytest.mark.parametrize("options", PLAIN.values(), ids=PLAIN)
@pytest.mark.parametrize("rows", [18, 1024])  # 18: two states, which do not divide 7
@pytest.mark.parametrize(("size", "loss_options"), CASES)
def test_losses_and_gradients_are_those_of_the_modules(
    monkeypatch, calls, options, rows, size, loss_options
):
    monkeypatch.setattr(critics, "CHUNK_ROWS", rows)
    assert_fuses(make_loss("cql", options, **loss_options), make_batch("cql", *size))
    assert max(calls) <= max(rows, 16)


@pytest.mark.parametrize("name", ["osr", "osr-v-cql", "edac"])
def test_other_losses_have_the_values_of_the_modules(calls, name):
    assert_fuses(make_loss(name, PLAIN["normalised"]), make_batch(name, 7))
    assert calls


@pytest.mark.parametrize("case", ["plain", "weights", "frozen"])
def test_rows_may_weigh_differently_and_layers_be_frozen(calls, case):
    loss, batch = make_loss(), make_batch("cql", 7)
    if case == "weights":
        batch["priority_weight"] = torch.rand(7).double()
    elif case == "frozen":
        networks = [critic() for _ in range(3)]
        for each in networks:
            each.module[0].requires_grad_(False)
        loss = make_loss(networks=networks)
    assert_fuses(loss, batch)
    # Three critics, of which each scores 7 x 9 actions: once, and with weights again.
    assert calls.count(63) == 3 * (1 + (case == "weights"))


@pytest.mark.parametrize("options", PLAIN.values(), ids=PLAIN)
def test_autocast_rounds_products_alone(options):
    loss, batch = make_loss("cql", options).float(), make_batch("cql", 64)
    fuse_critics(loss)
    exact = results(loss, batch)
    with torch.autocast("cpu", torch.bfloat16):
        half = results(loss, batch)
    assert half[0]["loss_cql"].dtype == torch.float32
    torch.testing.assert_close(dict(half[0]), dict(exact[0]), rtol=5e-2, atol=5e-2)
    found, wanted = (torch.cat([x.flatten() for x in y[1]]) for y in (half, exact))
    assert 0 < (found - wanted).norm() < 0.4 * wanted.norm()


def test_second_derivatives_and_broken_promises_are_refused():
    shapes = [(1, 4, 5), (1, 4)], [(1, 1, 4), (1, 1)]
    layers = [[torch.randn(x, requires_grad=True) for x in each] for each in shapes]
    rows = torch.randn(6, 3), torch.randn(2, 6, 2), torch.randn(2, 6)
    given = [2, 2], [], 1.0, None, *rows
    value = critics._SoftMaximum.apply(True, given, *layers[0], *layers[1])
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(value.sum(), layers[0][0], create_graph=True)
    with pytest.raises(RuntimeError, match="do not weigh alike"):
        (value * torch.arange(6)).sum().backward()


class Doubled(MLP):
    """A forward of its own."""

    def forward(self, *inputs):
        return 2 * super().forward(*inputs)


@pytest.mark.parametrize("kind", [*OTHERS, "forward"])
def test_other_critics_go_as_modules(calls, kind):
    networks = [critic(**OTHERS.get(kind, {})) for _ in range(2)]
    if kind == "forward":
        for each in networks:
            each.module.__class__ = Doubled
    loss = make_loss(networks=networks)
    fuse_critics(loss)
    loss(make_batch("cql", 7))
    assert not calls


def test_critics_with_a_hook_go_as_modules(calls):
    loss, batch = make_loss(), make_batch("cql", 7)
    fuse_critics(loss)
    for place in (loss.qvalue_network, loss.qvalue_network.module[0]):
        handle = place.register_forward_hook(lambda *_: None)
        loss(batch)
        assert not calls
        handle.remove()
    loss(batch)
    assert calls


def test_what_users_override_is_used(calls) -> None:
    class Halved(CQLLoss):
        def critic_output(self, *given):
            return super().critic_output(*given) / 2

    loss, batch = make_loss(), make_batch("cql", 7)
    loss.__class__ = Halved
    wanted = loss(batch)["pred_value"]
    fuse_critics(loss)
    assert loss(batch)["pred_value"] == wanted
    assert not calls
    loss.critics = own = Critics(loss)
    own.__class__ = type("Own", (Critics,), {})
    fuse_critics(loss)
    assert loss.critics is own


def test_sampled_actions_get_their_gradient() -> None:
    loss, batch, found = make_loss(), make_batch("cql", 5), []
    states, compared = batch.select("observation"), batch["action"]
    for _ in range(2):
        action = compared.repeat(3, 1, 1).requires_grad_()
        drawn = action, action.new_zeros(3, 5)
        terms = loss.critics.values_and_soft_maximum(
            states, compared, *drawn, alike=True
        )
        found += torch.autograd.grad(terms[1].sum(), action)
        fuse_critics(loss)
    assert found[0].any()
    torch.testing.assert_close(*found)
