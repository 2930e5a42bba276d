"""The kernel of plain MLP critics on a CPU: the numbers of ``functional.soft_maximum``.

Shapes: ``B`` states, ``N`` critics, ``M`` sampled actions of a state.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import MLP, ValueOperator

from torchrl_osr import functional
from torchrl_osr.fast import critics as critic_kernel
from torchrl_osr.fast.critics import PlainMLP, plain_mlp
from torchrl_osr.modules import critic_ensemble

CHUNKS = [1, 3, 64]
CELLS = [8, 6, 4]
KEYS = ("action", "state_action_value")


def normalised(norm_class: type[nn.Module] = nn.LayerNorm, *, cells=CELLS, **options):
    """Options of a critic that normalises each hidden layer."""
    each = [{"normalized_shape": width} | options for width in cells]
    return {"num_cells": cells, "norm_class": norm_class, "norm_kwargs": each}


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
WIDTHS = KINDS | {
    "one layer": {"num_cells": [7]},
    "growing": {"num_cells": [4, 9]},
    "one normalised layer": normalised(cells=[7], eps=1e-2),
}


def draws(size: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """States ``[2, size, 3]``, and six actions of each with log-densities."""
    state, action = torch.randn(2, size, 3), torch.rand(6, 2, size, 2)
    return state.to(dtype), action.to(dtype), torch.randn(6, 2, size, dtype=dtype)


def by_modules(critics, inputs, weight=1.0, temperature=1.0) -> list[Tensor]:
    """The equation critic by critic: values ``[N, B]``, and the gradients of their sum.

    Args:
        critics: to be called one by one.
        inputs: states, actions and log-densities.
        weight: of each value in the sum, ``[N, B]``.
        temperature: of the log-sum-exp.
    """
    state, action, log_prob = inputs
    states = state.expand(len(action), *state.shape)
    qvalue = [each.module(states, action).squeeze(-1) for each in critics]
    value = functional.soft_maximum(
        torch.stack(qvalue).movedim(1, -1),
        log_prob.movedim(0, -1),
        temperature=temperature,
    )
    gradients = [
        torch.stack(
            torch.autograd.grad((weight * value).sum(), each, retain_graph=True)
        )
        for each in zip(*(critic.parameters() for critic in critics), strict=True)
    ]
    return [value.detach(), *gradients]


def by_kernel(critics, inputs, weight=1.0, temperature=1.0, chunk_size=64):
    """The same numbers by the kernel."""
    params = TensorDict.from_modules(*critics, as_module=True)
    mlp = plain_mlp(critics[0], *KEYS)
    options = {"temperature": temperature, "chunk_size": chunk_size}
    value = critic_kernel.soft_maximum(params, mlp, *inputs, **options)
    total = (weight * value).sum()
    return [value.detach(), *torch.autograd.grad(total, mlp.parameters(params))]


@pytest.mark.parametrize("kind", WIDTHS)
@pytest.mark.parametrize("chunk_size", CHUNKS)
@pytest.mark.parametrize("temperature", [1.0, 1.7])
# What rows weigh in the gradient: all the same, or each its own with some masked out.
@pytest.mark.parametrize("weighs", [False, True])
def test_it_is_the_soft_maximum_of_the_critics_values(
    assert_same, kind, chunk_size, temperature, weighs
) -> None:
    critics = [critic(**WIDTHS[kind]) for _ in range(3)]
    inputs, weight = draws(5, torch.float64), torch.ones(3, 2, 5, dtype=torch.float64)
    if weighs:
        weight = torch.randn_like(weight) * (torch.rand_like(weight) > 0.3)
    wanted = by_modules(critics, inputs, weight, temperature)
    assert_same(by_kernel(critics, inputs, weight, temperature, chunk_size), wanted)


@each_kind
def test_half_precision_leaves_values_and_gradients_close(kind) -> None:
    critics = [critic(**KINDS[kind]).float() for _ in range(2)]
    inputs = draws(128, torch.float32)
    exact = by_modules(critics, inputs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        ours = by_kernel(critics, inputs)
    assert ours[0].dtype == torch.float32
    # Values, and all gradients together: eight bits of mantissa.
    for part in (slice(0, 1), slice(1, None)):
        wanted, half = (
            torch.cat([each.flatten() for each in numbers[part]])
            for numbers in (exact, ours)
        )
        assert not torch.equal(half, wanted), "nothing was in half precision"
        assert (half - wanted).norm() < 2e-2 * wanted.norm()


@pytest.mark.parametrize("kind", WIDTHS)
def test_values_are_those_of_the_modules(assert_same, kind) -> None:
    critics = [critic(**WIDTHS[kind]) for _ in range(3)]
    state, (action, *_), _ = draws(5, torch.float64)
    params = TensorDict.from_modules(*critics, as_module=True)
    value = critic_kernel.qvalue(params, plain_mlp(critics[0], *KEYS), state, action)
    assert_same(value, [each.module(state, action).squeeze(-1) for each in critics])


@pytest.fixture
def called(monkeypatch) -> list[str]:
    """Return a list that grows by where a soft maximum was computed."""
    found: list[str] = []

    def noting(module, name: str) -> None:
        original = module.soft_maximum

        def soft_maximum(*args, **kwargs):
            found.append(name)
            return original(*args, **kwargs)

        monkeypatch.setattr(module, "soft_maximum", soft_maximum)

    noting(critic_kernel, "kernel")
    noting(functional, "functional")
    return found


def test_the_kernel_runs_by_default_and_the_equation_without_chunks(
    family, family_batch, called
) -> None:
    batch = family_batch("cql", 10)
    for options, where in (({}, "kernel"), ({"chunk_size": None}, "functional")):
        family("cql", networks_of(family, "cql"), **options)(batch)
        assert called == [where]
        called.clear()
    # Nor where nothing is differentiated, or the states are.
    loss = family("cql", networks_of(family, "cql"))
    with torch.no_grad():
        loss(batch)
    batch["observation"].requires_grad_()
    loss(batch)["loss_cql"].backward()
    assert called == ["functional"] * 2
    assert batch["observation"].grad.abs().sum() > 0


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
    "masks and time": ("osr", {}, (2, 5), [masked]),
    "weights": ("cql", {}, (10,), [weighted]),
    "masks and weights": ("osr", {}, (10,), [masked, weighted]),
    "clipped": ("cql", {"clip_diff_min": 3.5}, (10,), []),
    "everything": ("cql-options", {}, (10,), [masked, weighted]),
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


def second_derivative(loss, batch, squared: bool) -> list[Tensor]:
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
    assert plain_mlp(critic(**OTHERS[kind]), *KEYS) is None


def test_layers_of_plain_critics_are_known_by_name() -> None:
    linear, norm = (critic(**options) for options in KINDS.values())
    assert plain_mlp(linear, *KEYS) == PlainMLP(["0", "2", "4", "6"], [], [])
    assert plain_mlp(norm, *KEYS) == PlainMLP(
        ["0", "3", "6", "9"], ["1", "4", "7"], [1e-2] * 3
    )
    assert plain_mlp(norm, "choice", "state_action_value") is None
    for built in critic_ensemble(3, 2, layer_norm=True):
        assert plain_mlp(built, *KEYS).norms == ["1", "4"]


def test_critics_that_are_no_mlp_go_as_modules() -> None:
    layers = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 1))
    other = ValueOperator(layers, in_keys=["observation", "action"])
    assert plain_mlp(other, *KEYS) is None
    pruned = critic()
    nn.utils.parametrizations.weight_norm(pruned.module[0])
    assert plain_mlp(pruned, *KEYS) is None

    class Shifted(MLP):
        def forward(self, *inputs):
            return super().forward(*inputs) + 1

    other = ValueOperator(Shifted(5, 1, num_cells=CELLS, activation_class=nn.ReLU))
    other.in_keys = ["observation", "action"]
    assert plain_mlp(other, *KEYS) is None


@pytest.mark.parametrize("replacement", [nn.Identity(), nn.LayerNorm((10, 8))])
def test_all_or_no_hidden_layers_are_normalised_by_themselves(replacement) -> None:
    other = critic(**normalised())
    other.module[1] = replacement
    assert plain_mlp(other, *KEYS) is None


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
    assert plain_mlp(network, *KEYS) is None
    handle.remove()
    assert plain_mlp(network, *KEYS) is not None


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
    forward, qvalue = critic_kernel._forward, critic_kernel.qvalue

    def counting_forward(chunk, *rest):
        counted.append(len(chunk.action))
        return forward(chunk, *rest)

    def counting_qvalue(params, mlp, state, action):
        counted.append(2 * action.shape[:-1].numel())
        return qvalue(params, mlp, state, action)

    monkeypatch.setattr(critic_kernel, "_forward", counting_forward)
    monkeypatch.setattr(critic_kernel, "qvalue", counting_qvalue)
    return counted


# 2 critics and K = 10: 33 actions a state, 30 of them sampled. Where rows differ in
# weight the sampled ones are computed once more.
@pytest.mark.parametrize(
    ("reduction", "change", "rows"),
    [("mean", None, 66), ("sum", None, 66), ("mean", weighted, 66 + 60)],
)
@pytest.mark.parametrize("chunk_size", [3, 64])
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


class Scaled(ValueOperator):
    """A critic that does something of its own with its network's output."""

    def forward(self, tensordict):
        out = super().forward(tensordict)
        return out.set("state_action_value", 10 * out["state_action_value"])


def test_a_critic_with_a_forward_of_its_own_is_not_plain() -> None:
    keys = {"in_keys": ["observation", "action"]}
    assert plain_mlp(
        ValueOperator(MLP(5, 1, num_cells=[4], activation_class=nn.ReLU), **keys), *KEYS
    )
    assert (
        plain_mlp(
            Scaled(MLP(5, 1, num_cells=[4], activation_class=nn.ReLU), **keys), *KEYS
        )
        is None
    )
