"""Plain MLP critics on a CPU: values and gradient, a few states at a time.

CQL's critics score 3K actions of every state. All at once, each layer writes and reads
again activations of many megabytes, which go through memory and are given back to the
operating system at every step. Here a few states at a time go forward and backward
through buffers that stay in the cache, in place, and only the gradient is kept. What
is left is the time of the matrix products.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``M`` sampled actions of a state,
``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

Layers = Sequence[tuple[Tensor, Tensor]]
"""Weight ``[out, in]`` and bias ``[out]`` of each linear layer of one critic."""


def linear_layers(
    network: TensorDictModuleBase, action_key: NestedKey
) -> list[str] | None:
    """Return the names of a plain MLP's linear layers, or ``None`` for another network.

    Plain is a :class:`~torchrl.modules.MLP` of linear layers with bias and ReLUs in
    between, with one output, that reads observations and then the action, and on which
    nobody has put a hook.
    """
    module = getattr(network, "module", None)
    if not isinstance(module, MLP) or network.in_keys[-1] != action_key:
        return None
    if any(each._forward_hooks or each._forward_pre_hooks for each in module.modules()):
        return None
    linear = {
        name: layer
        for name, layer in module.named_children()
        if isinstance(layer, nn.Linear)
    }
    kinds = [type(layer) for layer in module]
    plain = kinds == [nn.Linear, *[nn.ReLU, nn.Linear] * (len(linear) - 1)]
    if not plain or len(linear) < 2 or module[-1].out_features != 1:
        return None
    if any(layer.bias is None for layer in linear.values()):
        return None
    return list(linear)


def weights_and_biases(params: TensorDictBase, names: Sequence[str]) -> list[Tensor]:
    """Return ``[N, out, in]`` and ``[N, out]`` of each layer, one after the other."""
    return [params.get(("module", n, k)) for n in names for k in ("weight", "bias")]


def qvalue(
    params: TensorDictBase, names: Sequence[str], state: Tensor, action: Tensor
) -> Tensor:
    """Return the critics' values, ``[N, B]``: what calling the modules returns.

    One batched product a layer, without the modules' own machinery, which costs more
    than the arithmetic where there is one action a state.

    Args:
        params: of all critics, stacked.
        names: of the linear layers, see :func:`linear_layers`.
        state: ``[B, S]``.
        action: ``[B, A]``.
    """
    hidden = torch.cat([state, action], -1)
    batch, flat = hidden.shape[:-1], weights_and_biases(params, names)
    hidden = hidden.reshape(-1, hidden.shape[-1]).expand(len(flat[0]), -1, -1)
    for weight, bias in zip(flat[:-2:2], flat[1:-2:2], strict=True):
        hidden = torch.baddbmm(bias.unsqueeze(1), hidden, weight.mT).relu_()
    value = torch.baddbmm(flat[-1].unsqueeze(1), hidden, flat[-2].mT)
    # Under autocast the layers compute in half precision; what follows does not.
    return value.reshape(-1, *batch).to(state.dtype)


def soft_maximum(
    params: TensorDictBase,
    names: Sequence[str],
    state: Tensor,
    action: Tensor,
    log_prob: Tensor | None,
    *,
    temperature: float,
    chunk_size: int,
) -> Tensor:
    """Return :func:`~torchrl_osr.functional.soft_maximum` of the critics' values.

    Differentiable by the critics' parameters, once. The gradient is exact for every use
    of the result. It costs nothing more where all rows weigh the same, as in a mean or
    a sum; otherwise, with masks or importance weights, the chunks are computed once
    more with the weights that they have. Under autocast the products are in its
    precision; values, log-sum-exps and the gradient's sum stay in the inputs'.

    Args:
        params: of all critics, stacked.
        names: of the linear layers, see :func:`linear_layers`.
        state: ``[B, S]``.
        action: ``[M, B, A]``.
        log_prob: log-density of each action ``[M, B]``, or ``None`` for a plain sum.
        temperature: of the log-sum-exp.
        chunk_size: states that go through the critics at a time.

    Returns:
        ``[N, B]``.
    """
    flat = weights_and_biases(params, names)
    autocast = torch.is_autocast_enabled("cpu")
    dtype = torch.get_autocast_dtype("cpu") if autocast else state.dtype
    arguments = (state, action, log_prob, temperature, chunk_size, dtype, *flat)
    value: Tensor = _SoftMaximum.apply(*arguments)  # type: ignore[no-untyped-call]
    return value


class _SoftMaximum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        ctx.arguments = arguments
        with torch.autocast("cpu", enabled=False):  # it would cast once more
            value, gradient = _evaluate(None, *arguments)
        ctx.save_for_backward(*gradient)
        return value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Any:
        # Not torch's decorator of that name: it objects only where the upstream
        # gradient has a gradient itself, which that of a mean has not.
        if torch.is_grad_enabled():
            raise RuntimeError(
                "Critics in chunks are once_differentiable: pass chunk_size=None for "
                "second derivatives."
            )
        weight = upstream.flatten()[0]
        if bool((upstream == weight).all()):
            gradient = list(torch._foreach_mul(ctx.saved_tensors, weight))
        else:
            _, gradient = _evaluate(upstream, *ctx.arguments)
        return (*[None] * 6, *gradient)


def _evaluate(
    upstream: Tensor | None,
    state: Tensor,
    action: Tensor,
    log_prob: Tensor | None,
    temperature: float,
    chunk_size: int,
    dtype: torch.dtype,
    *flat: Tensor,
) -> tuple[Tensor, list[Tensor]]:
    """Return the values and the gradient of their sum, weighted by ``upstream``."""
    gradient = [torch.zeros_like(each) for each in flat]
    value = state.new_empty(len(flat[0]), len(state))
    flat = tuple(each.to(dtype) for each in flat)
    state, action = state.to(dtype), action.to(dtype)
    rows = len(action) * min(chunk_size, len(state))
    widths = [weight.shape[1] for weight in flat[:-2:2]]
    # Two buffers a layer, used again and again: activations, and their gradients.
    buffers = [[state.new_empty(rows, width) for width in widths] for _ in range(2)]
    for start in range(0, len(state), chunk_size):
        chunk = slice(start, start + chunk_size)
        density = 0.0 if log_prob is None else log_prob[:, chunk]
        inputs = state[chunk], action[:, chunk]
        for critic in range(len(value)):
            each = [_layers(tensors, critic) for tensors in (flat, gradient)]
            hidden = _forward(inputs, each[0], buffers[0])
            weight, bias = each[0][-1]
            qvalue = torch.mv(hidden[-1], weight[0]).to(value.dtype) + bias
            logits = (qvalue.view(inputs[1].shape[:-1]) - density) / temperature
            soft = logits.logsumexp(0)
            torch.mul(soft, temperature, out=value[critic, chunk])
            share = (logits - soft).exp_()
            if upstream is not None:
                share *= upstream[critic, chunk]
            _backward(inputs, share.view(-1).to(dtype), hidden, each, buffers[1])
    return value, gradient


def _layers(flat: Sequence[Tensor], critic: int) -> Layers:
    """Return weight and bias of each layer of one critic."""
    return [(w[critic], b[critic]) for w, b in zip(flat[::2], flat[1::2], strict=True)]


def _forward(
    inputs: tuple[Tensor, Tensor], layers: Layers, buffers: list[Tensor]
) -> list[Tensor]:
    """Write the hidden activations of a chunk into the buffers."""
    state, action = inputs
    rows, size = action.shape[:-1].numel(), state.shape[-1]
    hidden = [buffer[:rows] for buffer in buffers]
    weight, bias = layers[0]
    torch.mm(action.reshape(rows, -1), weight[:, size:].T, out=hidden[0])
    # The state's share of the first layer is the same for all of its actions.
    shared = torch.addmm(bias, state, weight[:, :size].T)
    hidden[0].view(len(action), *shared.shape).add_(shared)
    hidden[0].relu_()
    for (before, after), (weight, bias) in zip(
        pairwise(hidden), layers[1:-1], strict=True
    ):
        torch.addmm(bias, before, weight.T, out=after).relu_()
    return hidden


def _backward(
    inputs: tuple[Tensor, Tensor],
    share: Tensor,
    hidden: list[Tensor],
    layers_and_gradients: Sequence[Layers],
    buffers: list[Tensor],
) -> None:
    """Add the gradient of a chunk, from that of the values ``[M * b]``."""
    layers, gradients = layers_and_gradients
    state, action = inputs
    above = [buffer[: len(share)] for buffer in buffers]
    weight, bias = gradients[-1]
    weight[0] += torch.mv(hidden[-1].T, share)
    bias += share.sum()
    torch.mul(share.unsqueeze(1), layers[-1][0], out=above[-1])
    for layer in range(len(hidden) - 1, -1, -1):
        _mask(above[layer], hidden[layer])
        if layer:
            weight, bias = gradients[layer]
            _add_product(weight, above[layer].T, hidden[layer - 1])
            bias += above[layer].sum(0)
            torch.mm(above[layer], layers[layer][0], out=above[layer - 1])
    weight, bias = gradients[0]
    size = state.shape[-1]
    _add_product(weight[:, size:], above[0].T, action.reshape(len(share), -1))
    shared = above[0].view(len(action), len(state), -1).sum(0)
    _add_product(weight[:, :size], shared.T, state)
    bias += shared.sum(0)


def _add_product(total: Tensor, left: Tensor, right: Tensor) -> None:
    """Add a product, in the total's precision, to the total."""
    if total.dtype == left.dtype:
        total.addmm_(left, right)
    else:
        total += torch.mm(left, right)


def _mask(gradient: Tensor, activation: Tensor) -> None:
    """Set a gradient to 0, in place, where the ReLU did so with its input."""
    torch.ops.aten.threshold_backward.grad_input(
        gradient, activation, 0, grad_input=gradient
    )
