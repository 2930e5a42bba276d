"""Plain MLP critics on a CPU: values and gradient, a few states at a time.

CQL's critics score 3K actions of every state. All at once, each layer writes and reads
again activations of many megabytes, which go through memory and are given back to the
operating system at every step. Here a few states at a time go forward and backward
through buffers that stay in the cache, in place, and only the gradient is kept. What
is left is the time of the matrix products, and of layer normalisations if there are.

:func:`soft_maximum` replaces :func:`torchrl_osr.functional.soft_maximum` of the
critics' values; :class:`~torchrl_osr.OSRLoss` chooses between the two in one place.

Shapes: ``B`` states, ``b`` of them in a chunk, ``S`` observation, ``A`` action, ``M``
sampled actions of a state, ``N`` critics, ``H`` cells of a hidden layer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import layer_norm
from torchrl.modules import MLP, ValueOperator

from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Critics
from torchrl_osr.objectives.transitions import Transitions


class FusedCritics(Critics):
    """Evaluate plain MLP critics without their modules, and CQL(H)'s actions in chunks.

    Other critics, and those on a GPU, are evaluated as usual.
    """

    chunk_size = 64  # states that go through the critics at a time

    def values(
        self, states: TensorDictBase, action: Tensor, params: TensorDictBase
    ) -> Tensor:
        mlp = self._mlp()
        if mlp is None:
            return super().values(states, action, params)
        return qvalue(params, mlp, self._joined(states), action)

    def values_and_soft_maximum(
        self, batch: Transitions, action: Tensor, log_prob: Tensor
    ) -> tuple[Tensor, Tensor]:
        loss, mlp = self.loss, self._mlp()
        if mlp is None or not applicable(batch.s, action):
            return super().values_and_soft_maximum(batch, action, log_prob)
        alike = loss.clip_diff_min == -math.inf and loss.rows_weigh_alike(batch)
        return self.values(batch.s, batch.a, loss.qvalue_network_params), soft_maximum(
            loss.qvalue_network_params,
            mlp,
            self._joined(batch.s),
            action,
            log_prob,
            temperature=loss.temperature,
            chunk_size=self.chunk_size,
            equal_rows=alike,
        )

    def _mlp(self) -> PlainMLP | None:
        keys = self.loss.tensor_keys
        network = self.loss.qvalue_network
        return plain_mlp(network, keys.action, keys.state_action_value)

    def _joined(self, states: TensorDictBase) -> Tensor:
        keys = self.loss.qvalue_network.in_keys[:-1]
        return torch.cat([states.get(key) for key in keys], -1)


def fuse_critics(loss: nn.Module) -> None:
    """Let a loss, and the losses in it, evaluate their critics by this module."""
    for each in loss.modules():
        if isinstance(each, ActorCriticLoss):
            each.critics = FusedCritics(each)


class Layer(NamedTuple):
    """A linear layer and the layer normalisation that follows it, if one does.

    Attributes:
        weight: ``[out, in]``, or ``[N, out, in]`` of all critics.
        bias: ``[out]``.
        norm: scale and shift of the layer normalisation, ``[out]``, or nothing.
    """

    weight: Tensor
    bias: Tensor
    norm: tuple[Tensor, ...] = ()

    def to(self, dtype: torch.dtype) -> Layer:
        """Return the layer as under autocast, which casts the linear layer alone."""
        return Layer(self.weight.to(dtype), self.bias.to(dtype), self.norm)


class PlainMLP(NamedTuple):
    """The names of a plain MLP's layers.

    Attributes:
        linear: the linear layers.
        norms: the layer normalisations, after every linear layer but the last; empty
            where there are none.
        eps: of each layer normalisation.
    """

    linear: list[str]
    norms: list[str]
    eps: list[float]

    def parameters(self, params: TensorDictBase) -> list[Tensor]:
        """Return the parameters in the order of computation: those of each layer.

        Args:
            params: of the MLP, or of all critics, stacked.
        """
        names = self.linear
        if self.norms:
            pairs = zip(self.linear[:-1], self.norms, strict=True)
            names = [*(name for pair in pairs for name in pair), self.linear[-1]]
        modules = [params.get(("module", name)) for name in names]
        return [module.get(key) for module in modules for key in ("weight", "bias")]

    def layers(self, parameters: Sequence[Tensor]) -> list[Layer]:
        """Return the layers that parameters, or tensors like them, belong to."""
        size = 4 if self.norms else 2
        starts = range(0, len(parameters), size)
        each = [parameters[start : start + size] for start in starts]
        return [Layer(weight, bias, tuple(norm)) for weight, bias, *norm in each]

    def critics(self, stacked: Sequence[Tensor]) -> list[list[Layer]]:
        """Return the layers of each critic from those of all, which share memory."""
        each = zip(*(tensor.unbind() for tensor in stacked), strict=True)
        return [self.layers(parameters) for parameters in each]


def plain_mlp(
    network: TensorDictModuleBase, action_key: NestedKey, value_key: NestedKey
) -> PlainMLP | None:
    """Return the names of a plain MLP's layers, or ``None`` for another network.

    Plain is a :class:`~torchrl.modules.MLP` with one output that reads observations and
    then the action, of linear layers and ReLUs in between; before the ReLUs there may
    be layer normalisations. All of them have a weight and a bias, nobody has put a hook
    on them, and what they are wrapped in does nothing of its own.

    It takes microseconds and is not kept: hooks and layers may come and go.
    """
    if type(network) not in (TensorDictModule, ValueOperator):
        return None
    module: Any = network.module
    if type(module) is not MLP or network.in_keys[-1] != action_key:
        return None
    if value_key not in network.out_keys:
        return None
    if any(_has_hook(each) for each in (network, module, *module)):
        return None
    named = module._modules.items()
    linear = {name: each for name, each in named if type(each) is nn.Linear}
    norms = {name: each for name, each in named if type(each) is nn.LayerNorm}
    hidden = [nn.Linear, *[nn.LayerNorm] * bool(norms), nn.ReLU]
    kinds = [*hidden * (len(linear) - 1), nn.Linear]
    plain = len(linear) > 1 and [type(each) for each in module] == kinds
    if not plain or module[-1].out_features != 1:
        return None
    affine = [*linear.values(), *norms.values()]
    if any(each.weight is None or each.bias is None for each in affine):
        return None
    widths = [(each.out_features,) for each in linear.values()][: len(norms)]
    if [norm.normalized_shape for norm in norms.values()] != widths:
        return None
    return PlainMLP(list(linear), list(norms), [norm.eps for norm in norms.values()])


def _has_hook(module: nn.Module) -> bool:
    """Return whether calling the module is more than calling its ``forward``."""
    return bool(
        module._forward_hooks
        or module._forward_pre_hooks
        or module._backward_hooks
        or module._backward_pre_hooks
    )


def applicable(state: TensorDictBase, action: Tensor) -> bool:
    """Return whether :func:`soft_maximum` may run.

    It may on a CPU, outside of :func:`torch.compile`, where no gradient by the states
    is wanted.
    """
    return (
        action.device.type == "cpu"
        and torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not any(value.requires_grad for value in state.values(True, True))
    )


def qvalue(
    params: TensorDictBase, mlp: PlainMLP, state: Tensor, action: Tensor
) -> Tensor:
    """Return the critics' values, ``[N, B]``: what calling the modules returns.

    One batched product a layer, without the modules' own machinery, which costs more
    than the arithmetic where there is one action a state.

    Args:
        params: of all critics, stacked.
        mlp: their layers.
        state: ``[B, S]``.
        action: ``[B, A]``.
    """
    hidden = torch.cat([state, action], -1)
    batch, layers = hidden.shape[:-1], mlp.layers(mlp.parameters(params))
    hidden = hidden.reshape(-1, hidden.shape[-1]).expand(len(layers[0].bias), -1, -1)
    for index, layer in enumerate(layers):
        hidden = torch.baddbmm(layer.bias.unsqueeze(1), hidden, layer.weight.mT)
        if layer.norm:
            # Its own scale and shift would be those of all critics. It is given ones,
            # for without any torch 2.13 takes twice as long.
            ones = layer.norm[0].new_ones(hidden.shape[-1])
            zeros = torch.zeros_like(ones)
            hidden = layer_norm(hidden, ones.shape, ones, zeros, mlp.eps[index])
            scale, shift = (each.unsqueeze(1) for each in layer.norm)
            hidden = torch.addcmul(shift, hidden, scale)
        if layer is not layers[-1]:
            hidden = hidden.relu_()
    # Under autocast the layers compute in half precision; what follows does not.
    return hidden.reshape(-1, *batch).to(state.dtype)


def soft_maximum(
    params: TensorDictBase,
    mlp: PlainMLP,
    state: Tensor,
    action: Tensor,
    log_prob: Tensor,
    *,
    temperature: float,
    chunk_size: int,
    equal_rows: bool = False,
) -> Tensor:
    """Return :func:`~torchrl_osr.functional.soft_maximum` of the critics' values.

    Differentiable by the critics' parameters, once. The gradient is exact for every use
    of the result. It costs nothing more where all rows weigh the same, as in a mean or
    a sum; otherwise, with masks or importance weights, the chunks are computed once
    more with the weights that they have. Under autocast the products are in its
    precision; values, log-sum-exps and the gradient's sum stay in the inputs'.

    Args:
        params: of all critics, stacked.
        mlp: their layers.
        state: ``[B, S]``.
        action: ``[M, B, A]``.
        log_prob: log-density of each action, ``[M, B]``.
        temperature: of the log-sum-exp.
        chunk_size: states that go through the critics at a time.
        equal_rows: the caller knows that all rows weigh the same, so that nothing has
            to be decided by their weights; where they do not, the backward pass raises.

    Returns:
        ``[N, B]``.
    """
    autocast = torch.is_autocast_enabled("cpu")
    dtype = torch.get_autocast_dtype("cpu") if autocast else state.dtype
    # Any batch dimensions as one.
    rows = state.flatten(0, -2), action.flatten(1, -2), log_prob.flatten(1)
    arguments = (*rows, temperature, chunk_size, dtype, mlp)
    value: Tensor = _SoftMaximum.apply(  # type: ignore[no-untyped-call]
        equal_rows, *arguments, *mlp.parameters(params)
    )
    return value.reshape(-1, *state.shape[:-1])


class _SoftMaximum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, equal_rows: bool, *arguments: Any) -> Any:
        ctx.equal_rows, ctx.arguments = equal_rows, arguments
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
                "Fused critics are once_differentiable: leave fuse_critics out for "
                "second derivatives."
            )
        weight = upstream.flatten()[0]
        equal = (upstream == weight).all() | weight.isnan()  # NaN is no equal
        if ctx.equal_rows:
            torch._assert_async(
                equal, "Rows of one weight were promised, see equal_rows."
            )
        if ctx.equal_rows or bool(equal):
            gradient = list(torch._foreach_mul(ctx.saved_tensors, weight))
        else:
            _, gradient = _evaluate(upstream, *ctx.arguments)
        return (*[None] * 8, *gradient)


class _Chunk(NamedTuple):
    """A few states and their actions, with the buffers that they go through.

    Attributes:
        rows: where they are in the batch.
        state: ``[b, S]``.
        action: ``[M * b, A]``.
        products: for each hidden layer's product, ``[M * b, H]``.
        gradients: for the gradient by each hidden layer's output, but the last one's.
    """

    rows: slice
    state: Tensor
    action: Tensor
    products: list[Tensor]
    gradients: list[Tensor]


class _Hidden(NamedTuple):
    """What the backward pass needs of a hidden layer.

    Attributes:
        product: ``[M * b, H]``; without layer normalisation it has become the output.
        output: of the ReLU, ``[M * b, H]``.
        statistics: mean and inverse deviation of each row that was normalised.
    """

    product: Tensor
    output: Tensor
    statistics: Sequence[Tensor] = ()


def _evaluate(
    upstream: Tensor | None,
    state: Tensor,
    action: Tensor,
    log_prob: Tensor,
    temperature: float,
    chunk_size: int,
    dtype: torch.dtype,
    mlp: PlainMLP,
    *flat: Tensor,
) -> tuple[Tensor, list[Tensor]]:
    """Return the values and the gradient of their sum, weighted by ``upstream``."""
    value = state.new_empty(len(flat[0]), len(state))
    gradient = [torch.zeros_like(each) for each in flat]
    critics = [[layer.to(dtype) for layer in each] for each in mlp.critics(flat)]
    totals = mlp.critics(gradient)
    widths = [len(layer.bias) for layer in totals[0][:-1]]
    for chunk in _chunks(state.to(dtype), action.to(dtype), chunk_size, widths):
        density = log_prob[:, chunk.rows]
        for index, layers in enumerate(critics):
            hidden = _forward(chunk, layers, mlp.eps)
            output = torch.mv(hidden[-1].output, layers[-1].weight[0])
            qvalue = output.to(value.dtype) + layers[-1].bias
            logits = qvalue.view(len(action), -1) / temperature - density
            soft = logits.logsumexp(0)
            torch.mul(soft, temperature, out=value[index, chunk.rows])
            share = (logits - soft).exp_()
            if upstream is not None:
                share *= upstream[index, chunk.rows]
            _backward(chunk, share.view(-1).to(dtype), hidden, layers, totals[index])
    return value, gradient


def _chunks(
    state: Tensor, action: Tensor, chunk_size: int, widths: list[int]
) -> Iterator[_Chunk]:
    """Return the chunks of a batch; all go through the same buffers."""
    rows = len(action) * min(chunk_size, len(state))
    buffers = [
        [state.new_empty(rows, width) for width in each]
        for each in (widths, widths[:-1])
    ]
    for start in range(0, len(state), chunk_size):
        part = slice(start, start + chunk_size)
        flat = action[:, part].flatten(0, 1)
        views = [[buffer[: len(flat)] for buffer in each] for each in buffers]
        yield _Chunk(part, state[part], flat, *views)


def _forward(chunk: _Chunk, layers: list[Layer], eps: list[float]) -> list[_Hidden]:
    """Run a chunk through the hidden layers."""
    hidden: list[_Hidden] = []
    for index, layer in enumerate(layers[:-1]):
        product = chunk.products[index]
        if index:
            torch.addmm(layer.bias, hidden[-1].output, layer.weight.T, out=product)
        else:
            _first_product(chunk, layer)
        if layer.norm:
            scale, shift = layer.norm
            output, *statistics = torch.native_layer_norm(
                product, scale.shape, scale, shift, eps[index]
            )
            hidden.append(_Hidden(product, output.relu_(), statistics))
        else:
            hidden.append(_Hidden(product, product.relu_()))
    return hidden


def _first_product(chunk: _Chunk, layer: Layer) -> None:
    """Write the product of the first layer."""
    state, action, product = chunk.state, chunk.action, chunk.products[0]
    size = state.shape[-1]
    torch.mm(action, layer.weight[:, size:].T, out=product)
    # The state's share of the first layer is the same for all of its actions.
    shared = torch.addmm(layer.bias, state, layer.weight[:, :size].T)
    product.view(-1, *shared.shape).add_(shared)


def _backward(
    chunk: _Chunk,
    share: Tensor,
    hidden: list[_Hidden],
    layers: list[Layer],
    total: list[Layer],
) -> None:
    """Add a chunk's gradient, from that of the values ``[M * b]``, to the total."""
    output = hidden[-1].output
    total[-1].weight[0] += torch.mv(output.T, share)
    total[-1].bias.add_(share.sum())
    above = _relu_backward(layers[-1].weight.expand_as(output), output)
    above.mul_(share.unsqueeze(1))
    for index in range(len(hidden) - 1, -1, -1):
        if layers[index].norm:
            each = hidden[index], layers[index], total[index]
            above = _normalisation_backward(above, *each)
        if index:
            output, below = hidden[index - 1].output, chunk.gradients[index - 1]
            _add_product(total[index].weight, above.T, output)
            total[index].bias.add_(above.sum(0))
            torch.mm(above, layers[index].weight, out=below)
            above = _relu_backward(below, output)
    size = chunk.state.shape[-1]
    weight, bias, *_ = total[0]
    _add_product(weight[:, size:], above.T, chunk.action)
    shared = above.view(-1, len(chunk.state), above.shape[-1]).sum(0)
    _add_product(weight[:, :size], shared.T, chunk.state)
    bias += shared.sum(0)


def _normalisation_backward(
    above: Tensor, hidden: _Hidden, layer: Layer, total: Layer
) -> Tensor:
    """Return the gradient by what is normalised; add those of scale and shift."""
    # Not in half precision: torch 2.13 also adds up the rows' gradients by scale and
    # shift in it, whose sums are then off by half for two thousand rows.
    dtype = total.bias.dtype
    product, statistics = hidden.product.to(dtype), hidden.statistics
    gradient, *others = torch.ops.aten.native_layer_norm_backward(
        above.to(dtype), product, layer.bias.shape, *statistics, *layer.norm, [True] * 3
    )
    for each, other in zip(total.norm, others, strict=True):
        each.add_(other)
    result: Tensor = gradient.to(above.dtype)
    return result


def _add_product(total: Tensor, left: Tensor, right: Tensor) -> None:
    """Add a product, in the total's precision, to the total."""
    if total.dtype == left.dtype:
        total.addmm_(left, right)
    else:
        total += torch.mm(left, right)


def _relu_backward(gradient: Tensor, output: Tensor) -> Tensor:
    """Return the gradient by a ReLU's input, in the place of what it has put out."""
    masked: Tensor = torch.ops.aten.threshold_backward.grad_input(
        gradient, output, 0, grad_input=output
    )
    return masked
