"""Plain MLP critics on a CPU: the same numbers, a few states at a time or all at once.

Shapes: ``B`` states, ``N`` critics.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP, ValueOperator

from torchrl_osr.modules import critic_ensemble
from torchrl_osr.objectives import mlp_critics
from torchrl_osr.objectives.mlp_layers import PlainMLP, plain_mlp

CHUNKS = [1, 3, 64]
CELLS = [8, 6, 4]


def normalised(norm_class: type[nn.Module] = nn.LayerNorm, **options):
    """Options of a critic that normalises each hidden layer."""
    each = [{"normalized_shape": width} | options for width in CELLS]
    return {"norm_class": norm_class, "norm_kwargs": each}


def critic(*, in_keys=("observation", "action"), size: int = 5, **options):
    """A critic of three hidden layers; ReLUs unless told otherwise."""
    options = {"num_cells": CELLS, "activation_class": nn.ReLU} | options
    network = MLP(size, 1, **options)
    for layer in network:
        if isinstance(layer, nn.LayerNorm) and layer.bias is not None:
            nn.init.normal_(layer.weight)
            nn.init.normal_(layer.bias)
    return ValueOperator(network, in_keys=list(in_keys)).double()


# An eps that is not the default, and large enough to count.
KINDS = {"linear": {}, "normalised": normalised(eps=1e-2)}
each_kind = pytest.mark.parametrize("kind", KINDS)


def networks_of(family, name: str, *, plain: bool = True, **options):
    """Networks with two deeper critics, the same in every call.

    Args:
        family: the factory.
        name: of the loss.
        plain: whether nobody has put a hook on the critics, which else are run as
            modules.
        options: of the critics.
    """
    networks = family.networks(name)
    networks.critics = [critic(**options) for _ in range(2)]
    for each in networks.critics if not plain else []:
        each.module.register_forward_hook(lambda *_: None)
    return networks


def masked(batch):
    batch["collector", "mask"] = torch.arange(10).reshape(*batch.batch_size, 1) % 4 > 0
    return batch


def weighted(batch):
    weight = torch.linspace(0.5, 2.0, 10).double()
    batch["priority_weight"] = weight.reshape(batch.batch_size)
    return batch


CASES = {
    "cql": ("cql", {}, (10,), []),
    "osr": ("osr", {}, (10,), []),
    "time dimension": ("cql", {}, (2, 5), []),
    "masks": ("cql", {}, (10,), [masked]),
    "masks and time": ("osr", {}, (2, 5), [masked]),
    "weights": ("cql", {}, (10,), [weighted]),
    "masks and weights": ("osr", {}, (10,), [masked, weighted]),
    "clipped": ("cql", {"clip_diff_min": 3.4, "clip_diff_max": 3.7}, (10,), []),
    "lagrange": ("cql", {"with_lagrange": True, "lagrange_thresh": 1.0}, (10,), []),
    "temperature": ("cql", {"temperature": 1.7}, (10,), []),
    "plain sum": ("cql", {"importance_sample": False}, (2, 5), []),
    "everything": ("cql-options", {"clip_diff_max": 3.46}, (10,), [masked, weighted]),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
@each_kind
def test_chunks_change_neither_losses_nor_gradients(
    family, family_batch, record, assert_same, case, reduction, kind
) -> None:
    name, options, size, changes = CASES[case]
    batch = family_batch(name, *size)
    for change in changes:
        batch = change(batch)

    def numbers(chunk_size: int | None, **networks):
        loss = family(
            name,
            networks_of(family, name, **networks, **KINDS[kind]),
            reduction=reduction,
            chunk_size=chunk_size,
            **options,
        )
        return record(loss, batch)

    modules = numbers(None, plain=False)
    for chunk_size in (*CHUNKS, None):
        assert_same(numbers(chunk_size), modules)


@pytest.mark.parametrize("case", ["clipped", "everything"])
def test_clip_bounds_reach_some_rows_and_not_others(
    family, family_batch, seeded, case
) -> None:
    name, options, _, _ = CASES[case]
    free, bound = (
        seeded(
            family(name, networks_of(family, name), reduction="none", **each),
            family_batch(name, 10),
        )["loss_cql"]
        for each in ({}, options)
    )
    assert 0 < (free == bound).sum() < 10, free


def test_default_is_a_chunk_size(
    family, family_batch, record, assert_same_bits
) -> None:
    batch = family_batch("cql", 10)
    default, given = (
        record(family("cql", networks_of(family, "cql"), **options), batch)
        for options in ({}, {"chunk_size": 64})
    )
    assert_same_bits(default, given)


def test_critics_of_several_observations(
    family, family_batch, record, assert_same
) -> None:
    batch = family_batch("cql", 10)
    for group in (batch, batch["next"]):
        group["goal"] = 0.5 * group["observation"]
    options = {"in_keys": ["goal", "observation", "action"], "size": 8}
    modules, chunked = (
        record(family("cql", networks_of(family, "cql", plain=plain, **options)), batch)
        for plain in (False, True)
    )
    assert_same(chunked, modules)


def test_frozen_layers_stay_without_gradient(
    family, family_batch, record, assert_same
) -> None:
    batch, numbers = family_batch("cql", 10), []
    for plain in (False, True):
        networks = networks_of(family, "cql", plain=plain)
        loss = family("cql", networks)
        loss.qvalue_network_params["module", "2", "weight"].requires_grad_(False)
        numbers.append(record(loss, batch))
    assert len(numbers[0]) < len(
        record(family("cql", networks_of(family, "cql")), batch)
    )
    assert_same(*numbers)


def test_nothing_is_kept_where_no_gradient_is_wanted(
    family, family_batch, seeded, assert_same
) -> None:
    loss, batch = family("cql", networks_of(family, "cql")), family_batch("cql", 10)
    expected = seeded(loss, batch)
    with torch.no_grad():
        out = seeded(loss, batch)
    assert not out["loss_cql"].requires_grad
    assert_same([out["loss_cql"]], [expected["loss_cql"].detach()])


@each_kind
def test_gradient_is_that_of_a_small_step(family, family_batch, seeded, kind) -> None:
    loss = family("cql", networks_of(family, "cql", **KINDS[kind]))
    batch = weighted(family_batch("cql", 10))
    params = list(loss.qvalue_network_params.parameters())
    out = seeded(loss, batch)["loss_cql"]
    gradients = torch.autograd.grad(out, params, allow_unused=True)
    for parameter, gradient in zip(params, gradients, strict=True):
        index, step = (0,) * parameter.ndim, 1e-6
        values = []
        for sign in (1, -1):
            parameter.data[index] += sign * step
            values.append(seeded(loss, batch)["loss_cql"].item())
            parameter.data[index] -= sign * step
        slope = (values[0] - values[1]) / (2 * step)
        assert gradient[index].item() == pytest.approx(slope, abs=1e-7)


def second_derivative(loss, batch, squared: bool) -> list[torch.Tensor]:
    """Gradient of the squared gradient of the conservative term, or of its square."""
    params = list(loss.qvalue_network_params.parameters())
    out = loss(batch)["loss_cql"]
    out = out.square() if squared else out
    first = torch.autograd.grad(out, params, create_graph=True)
    norm = sum(gradient.square().sum() for gradient in first)
    norm.backward()
    return [parameter.grad for parameter in params if parameter.grad is not None]


@pytest.mark.parametrize("squared", [True, False])
def test_second_derivatives_need_the_critics_all_at_once(
    family, family_batch, squared
) -> None:
    batch = family_batch("cql", 10)
    chunked, whole = (
        family("cql", networks_of(family, "cql"), chunk_size=chunk_size)
        for chunk_size in (3, None)
    )
    assert any(
        gradient.abs().max() > 0
        for gradient in second_derivative(whole, batch, squared)
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        second_derivative(chunked, batch, squared)


@pytest.mark.parametrize("chunk_size", [0, -1])
def test_chunks_without_a_state_are_refused(family, chunk_size) -> None:
    expected = f"chunk_size must be at least 1 or None, got {chunk_size}"
    with pytest.raises(ValueError, match=expected):
        family("cql", chunk_size=chunk_size)


OTHERS = {
    "another activation": {"activation_class": nn.Tanh},
    "another activation of normalised layers": {"activation_class": nn.Tanh}
    | normalised(),
    "normalisation without parameters": normalised(elementwise_affine=False),
    "normalisation without shift": normalised(bias=False),
    "another normalisation": normalised(nn.RMSNorm),
    "batch normalisation": {
        "norm_class": nn.BatchNorm1d,
        "norm_kwargs": [{"num_features": width} for width in CELLS],
    },
    "dropout": {"dropout": 0.5},
    "dropout of normalised layers": {"dropout": 0.5} | normalised(),
    "activation at the end": {"activate_last_layer": True},
    "no bias": {"bias_last_layer": False},
    "a single layer": {"num_cells": [], "depth": 0},
    "the action first": {"in_keys": ("action", "observation")},
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_critics_go_as_modules(kind) -> None:
    assert plain_mlp(critic(**OTHERS[kind]), "action") is None


def test_layers_of_plain_critics_are_known_by_name() -> None:
    linear, norm = (critic(**options) for options in KINDS.values())
    assert plain_mlp(linear, "action") == PlainMLP(["0", "2", "4", "6"], [], [])
    assert plain_mlp(norm, "action") == PlainMLP(
        ["0", "3", "6", "9"], ["1", "4", "7"], [1e-2] * 3
    )
    assert plain_mlp(norm, "choice") is None
    for built in critic_ensemble(3, 2, layer_norm=True):
        assert plain_mlp(built, "action").norms == ["1", "4"]


def test_critics_that_are_no_mlp_go_as_modules() -> None:
    layers = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 1))
    other = ValueOperator(layers, in_keys=["observation", "action"])
    assert plain_mlp(other, "action") is None
    pruned = critic()
    nn.utils.parametrizations.weight_norm(pruned.module[0])
    assert plain_mlp(pruned, "action") is None

    class Shifted(MLP):
        def forward(self, *inputs):
            return super().forward(*inputs) + 1

    other = ValueOperator(Shifted(5, 1, num_cells=CELLS, activation_class=nn.ReLU))
    other.in_keys = ["observation", "action"]
    assert plain_mlp(other, "action") is None


@pytest.mark.parametrize("replacement", [nn.Identity(), nn.LayerNorm((10, 8))])
def test_all_or_no_hidden_layers_are_normalised_by_themselves(replacement) -> None:
    other = critic(**normalised())
    other.module[1] = replacement
    assert plain_mlp(other, "action") is None


HOOKS = {
    "forward": lambda module: module.register_forward_hook(lambda *_: None),
    "before": lambda module: module.register_forward_pre_hook(lambda *_: None),
    "backward": lambda module: module.register_full_backward_hook(lambda *_: None),
}


@pytest.mark.parametrize("hook", HOOKS)
@pytest.mark.parametrize("place", ["network", "module", "layer"])
def test_critics_with_a_hook_go_as_modules(hook, place) -> None:
    network = critic(**normalised())
    places = {"network": network, "module": network.module, "layer": network.module[1]}
    handle = HOOKS[hook](places[place])
    assert plain_mlp(network, "action") is None
    handle.remove()
    assert plain_mlp(network, "action") is not None


@each_kind
def test_a_loss_follows_a_hook_and_a_change_of_its_critics(
    family, family_batch, seeded, count_rows, kind
) -> None:
    loss = family("cql", networks_of(family, "cql", **KINDS[kind]))
    batch, calls = family_batch("cql", 10), []
    plain = seeded(loss, batch)["loss_cql"]
    assert count_rows
    count_rows.clear()
    module = loss.qvalue_network.module
    handle = module[0].register_forward_hook(lambda *_: calls.append(1))
    torch.testing.assert_close(seeded(loss, batch)["loss_cql"], plain)
    handle.remove()
    assert calls
    module[-2] = nn.Tanh()
    assert not torch.isclose(seeded(loss, batch)["loss_cql"], plain)
    assert not count_rows


@pytest.mark.parametrize(
    "kind",
    ["another activation", "normalisation without parameters", "dropout"],
)
def test_chunks_do_not_concern_other_critics(
    family, family_batch, record, assert_same_bits, kind
) -> None:
    # Not a bit differs: the draws of a dropout are those of one pass.
    batch = family_batch("cql", 10)
    one, whole = (
        record(
            family(
                "cql",
                networks_of(family, "cql", **OTHERS[kind]),
                chunk_size=chunk_size,
            ),
            batch,
        )
        for chunk_size in (1, None)
    )
    assert_same_bits(one, whole)


@pytest.fixture
def count_rows(monkeypatch):
    """Return a list that grows by the rows of every pass of a plain critic."""
    counted: list[int] = []
    forward, qvalue = mlp_critics._forward, mlp_critics.qvalue

    def counting_forward(chunk, *rest):
        counted.append(len(chunk.action))
        return forward(chunk, *rest)

    def counting_qvalue(params, mlp, state, action):
        counted.append(2 * action.shape[:-1].numel())
        return qvalue(params, mlp, state, action)

    monkeypatch.setattr(mlp_critics, "_forward", counting_forward)
    monkeypatch.setattr(mlp_critics, "qvalue", counting_qvalue)
    return counted


# 2 critics and K = 10: 33 actions a state, 30 of them sampled. Where rows differ in
# weight the sampled ones are computed once more.
@pytest.mark.parametrize(
    ("reduction", "change", "rows"),
    [("mean", None, 66), ("sum", None, 66), ("mean", weighted, 66 + 60)],
)
@pytest.mark.parametrize("chunk_size", CHUNKS)
@each_kind
def test_no_row_is_scored_twice_where_all_weigh_the_same(
    family, family_batch, count_rows, reduction, change, rows, chunk_size, kind
) -> None:
    batch = family_batch("cql", 10)
    batch = batch if change is None else change(batch)
    loss = family(
        "cql",
        networks_of(family, "cql", **KINDS[kind]),
        num_random=10,
        reduction=reduction,
        chunk_size=chunk_size,
    )
    out = loss(batch)
    sum(out[key] for key in family["cql"].groups).backward()
    assert sum(count_rows) / batch.numel() == rows


@each_kind
def test_autocast_changes_the_numbers_as_it_does_those_of_modules(
    family, family_batch, seeded, kind
) -> None:
    batch = family_batch("cql", 10)
    batch = batch.apply(lambda t: t.float() if t.is_floating_point() else t)
    out = []
    for plain in (True, False):
        networks = networks_of(family, "cql", plain=plain, **KINDS[kind])
        loss = family("cql", networks).float()
        with torch.autocast("cpu", dtype=torch.bfloat16):
            out.append(seeded(loss, batch)["loss_cql"])
        exact = seeded(loss, batch)["loss_cql"]
        assert out[-1] != exact
        torch.testing.assert_close(out[-1], exact, rtol=0.02, atol=0.05)
    torch.testing.assert_close(*out, rtol=0.02, atol=0.05)
    assert out[0].dtype == torch.float32


@pytest.mark.parametrize("weighs", [True, False])
@each_kind
def test_half_precision_leaves_values_and_gradients_as_close_as_modules_do(
    family, kind, weighs
) -> None:
    loss = family("cql", networks_of(family, "cql", **KINDS[kind])).float()
    params = loss.qvalue_network_params
    state, action = torch.randn(256, 3), torch.rand(9, 256, 2)
    log_prob = torch.randn(9, 256) if weighs else None

    def chunked() -> torch.Tensor:
        mlp = plain_mlp(loss.qvalue_network, "action")
        arguments = (params, mlp, state, action, log_prob)
        return mlp_critics.soft_maximum(*arguments, temperature=1.0, chunk_size=64)

    def modules() -> torch.Tensor:
        states = TensorDict({"observation": state.expand(9, -1, -1)}, [9, 256])
        with loss.qvalue_network.module.register_forward_hook(lambda *_: None):
            qvalue = loss._qvalue(states, action, params)
        density = 0.0 if log_prob is None else log_prob
        return (qvalue - density).logsumexp(1)

    def numbers(function, *, half: bool) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=half):
            value = function()
        gradients = torch.autograd.grad(value.sum(), list(params.parameters()))
        assert value.dtype == torch.float32
        return value.detach(), torch.cat([each.flatten() for each in gradients])

    exact = numbers(modules, half=False)
    for wanted, ours, theirs in zip(
        exact, numbers(chunked, half=True), numbers(modules, half=True), strict=True
    ):
        assert not torch.equal(ours, wanted), "nothing was computed in half precision"
        assert (ours - wanted).norm() < 2e-2 * wanted.norm()
        assert (theirs - wanted).norm() < 2e-2 * wanted.norm()
