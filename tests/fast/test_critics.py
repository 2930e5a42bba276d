"""Fused critics against their modules: losses, gradients, and who goes as modules."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate

from torchrl_osr import CQLLoss, OSRLoss
from torchrl_osr.fast import critics, fuse_critics
from torchrl_osr.lab.losses import EDACLoss
from torchrl_osr.modules import tanh_gaussian_actor, tanh_gaussian_inverse_dynamics

CELLS = [8, 6, 4]


def normalised(**options):
    """Options of a critic that normalises each hidden layer."""
    each = [{"normalized_shape": width} | options for width in CELLS]
    return {"norm_class": nn.LayerNorm, "norm_kwargs": each}


# An eps that is not the default, and large enough to count.
PLAIN = {"one layer": {"num_cells": [7]}, "normalised": normalised(eps=1e-2)}
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


def make_loss(kind=CQLLoss, options=(), networks=None, **loss_options):
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(3, 2, num_cells=[8]).double()
    networks = networks or [critic(**dict(options)) for _ in range(3)]
    models = [tanh_gaussian_inverse_dynamics(3, 2, num_cells=[8]).double()]
    models = models if kind is OSRLoss else []
    loss = kind(actor, networks, *models, **loss_options)
    SoftUpdate(loss, tau=0.1)  # TorchRL warns of losses without one
    return loss


def results(loss, batch: TensorDict) -> tuple[TensorDict, list]:
    torch.manual_seed(3)
    losses = loss(batch.clone())
    total = sum(value.square().sum() for key, value in losses.items() if "loss_" in key)
    params = [each for each in loss.parameters() if each.requires_grad]
    return losses.detach(), list(torch.autograd.grad(total, params))


def assert_close(found, wanted, **tolerance) -> None:
    torch.testing.assert_close(dict(found[0]), dict(wanted[0]), **tolerance)
    torch.testing.assert_close(found[1], wanted[1], **tolerance)


def assert_fuses(loss, batch) -> None:
    """Compare the fused critics with the modules."""
    wanted = results(loss, batch)
    fuse_critics(loss)
    assert_close(results(loss, batch), wanted)


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
@pytest.mark.parametrize("rows", [12, 1024])  # 12: two states, which do not divide 7
@pytest.mark.parametrize(
    ("size", "loss_options"),
    [
        ([7], {}),
        ([2, 5], {"temperature": 1.7}),
        ([7], {"clip_diff_min": 0.0}),
        ([7], {"reduction": "sum"}),
    ],
)
def test_losses_and_gradients_are_those_of_the_modules(
    make_batch, monkeypatch, calls, options, rows, size, loss_options
):
    monkeypatch.setattr(critics, "CHUNK_ROWS", rows)
    loss = make_loss(options=options, num_random=2, **loss_options)
    batch = make_batch(*size)
    assert_fuses(loss, batch)
    assert max(calls) <= max(rows, 16)


@pytest.mark.parametrize("kind", [OSRLoss, EDACLoss])
def test_other_losses_have_the_values_of_the_modules(make_batch, calls, kind):
    options = {} if kind is EDACLoss else {"num_random": 2}
    loss, batch = make_loss(kind, PLAIN["normalised"], **options), make_batch(7)
    assert_fuses(loss, batch)
    assert calls


@pytest.mark.parametrize("weighted", [False, True])
def test_rows_may_weigh_differently(make_batch, calls, weighted):
    loss, batch = make_loss(num_random=2), make_batch(7)
    if weighted:
        batch["priority_weight"] = torch.rand(7).double()
    assert_fuses(loss, batch)
    # Three critics, of which each scores 7 x 6 actions: once, and with weights again.
    assert calls.count(42) == 3 * (1 + weighted)


def test_layers_may_be_frozen(make_batch, calls):
    networks = [critic() for _ in range(2)]
    for each in networks:
        each.module[0].requires_grad_(False)
    loss, batch = make_loss(networks=networks, num_random=2), make_batch(7)
    assert_fuses(loss, batch)
    assert calls


@pytest.mark.parametrize("options", PLAIN.values(), ids=PLAIN)
def test_autocast_rounds_products_alone(make_batch, options):
    loss = make_loss(options=options, num_random=2).float()
    batch = make_batch(64).apply(lambda x: x.float() if x.is_floating_point() else x)
    fuse_critics(loss)
    exact = results(loss, batch)
    with torch.autocast("cpu", torch.bfloat16):
        half = results(loss, batch)
    assert half[0]["loss_cql"].dtype == torch.float32
    assert_close((half[0], []), (exact[0], []), rtol=5e-2, atol=5e-2)
    found, wanted = (
        torch.cat([x.flatten() for x in each[1]]) for each in (half, exact)
    )
    assert 0 < (found - wanted).norm() < 0.4 * wanted.norm()


def test_second_derivatives_and_broken_promises_are_refused():
    shapes = [(1, 4, 5), (1, 4)], [(1, 1, 4), (1, 1)]
    layers = [
        tuple(torch.randn(each, requires_grad=True) for each in layer)
        for layer in shapes
    ]
    rows = torch.randn(6, 3), torch.randn(2, 6, 2), torch.randn(2, 6)
    value = critics.soft_maximum(True, ([2, 2], [], 1.0, None, *rows), layers)
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(value.sum(), layers[0][0], create_graph=True)
    with pytest.raises(RuntimeError, match="do not weigh alike"):
        (value * torch.arange(6)).sum().backward()


@pytest.mark.parametrize("options", OTHERS.values(), ids=OTHERS)
def test_other_critics_go_as_modules(make_batch, calls, options):
    networks = [critic(**options) for _ in range(2)]
    loss = make_loss(networks=networks, num_random=2)
    fuse_critics(loss)
    loss(make_batch(7))
    assert not calls


class Doubled(MLP):
    """A forward of its own."""

    def forward(self, *inputs):
        return 2 * super().forward(*inputs)


def test_critics_with_a_forward_or_a_hook_of_their_own_go_as_modules(make_batch, calls):
    network = Doubled(5, 1, num_cells=CELLS, activation_class=nn.ReLU).double()
    doubled = ValueOperator(network, in_keys=["observation", "action"])
    loss = make_loss(networks=[doubled], num_random=2)
    fuse_critics(loss)
    loss(make_batch(7))
    assert not calls
    loss = make_loss(num_random=2)
    fuse_critics(loss)
    for place in (loss.qvalue_network, loss.qvalue_network.module[0]):
        handle = place.register_forward_hook(lambda *_: None)
        loss(make_batch(7))
        assert not calls
        handle.remove()
    loss(make_batch(7))
    assert calls
