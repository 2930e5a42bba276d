"""Plain MLP critics on a CPU, in fewer and larger products.

Critics are evaluated by one batched product a layer, without their modules, which take
longer than the arithmetic. CQL's critics score 3K actions of every state. All at once,
each layer writes and reads again activations of many megabytes. Here a few states at a
time go forward and backward through the cache, and only the gradient is kept.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``M`` sampled actions of a state,
``N`` critics, ``H`` cells of a hidden layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.functional import layer_norm
from torchrl.modules import MLP, ValueOperator

from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Critics

HOOKS = "_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks"

CHUNK_ROWS = 1024
"""Actions that go through the critics at a time: their activations fit the cache."""

Layers = list[tuple[Tensor, ...]]
"""Weight ``[N, out, in]`` and bias ``[N, out]`` of each linear layer; then scale and
shift ``[N, out]`` of the layer normalisation that follows, if one does."""


class FusedCritics(Critics):
    """Evaluate plain MLP critics without their modules, and CQL(H)'s actions in chunks.

    Plain is a :class:`~torchrl.modules.MLP` with one output that reads an observation
    and then the action, of linear layers and ReLUs in between; before the ReLUs there
    may be layer normalisations. Other critics and those with hooks are evaluated as
    usual. The chunks are for a CPU alone.
    """

    def values(
        self, states: TensorDictBase, action: Tensor, params: TensorDictBase
    ) -> Tensor:
        if (eps := self._eps()) is None:
            return super().values(states, action, params)
        rows = torch.cat([self._state(states), action], -1)
        return _values(self._layers(params), eps, rows)

    def values_and_soft_maximum(
        self, states: TensorDictBase, compared: Tensor, *sampled: Tensor, alike: bool
    ) -> tuple[Tensor, Tensor]:
        action, log_prob = sampled
        loss, eps = self.loss, self._eps()
        if (
            eps is None
            or action.device.type != "cpu"
            or not torch.is_grad_enabled()
            or torch.compiler.is_compiling()
            or any(x.requires_grad for x in (*sampled, *states.values(True, True)))
        ):
            return super().values_and_soft_maximum(
                states, compared, *sampled, alike=alike
            )
        params, state = loss.qvalue_network_params, self._state(states)
        layers = self._layers(params)
        autocast, sizes = torch.is_autocast_enabled("cpu"), [*map(len, layers)]
        dtype = torch.get_autocast_dtype("cpu") if autocast else None
        given = sizes, eps, loss.temperature, dtype, state, action, log_prob
        soft_maximum = _SoftMaximum.apply(alike, given, *sum(layers, ()))
        return self.values(states, compared, params), soft_maximum

    def _eps(self) -> list[float] | None:
        """Return the ``eps`` of each normalisation, or ``None`` for other networks.

        It takes microseconds and is not kept: hooks and layers may come and go.
        """
        keys, network = self.loss.tensor_keys, self.loss.qvalue_network
        module: Any = getattr(network, "module", None)
        if (
            type(network) not in (TensorDictModule, ValueOperator)
            or type(module) is not MLP
            or len(network.in_keys) != 2
            or network.in_keys[-1] != keys.action
            or keys.state_action_value not in network.out_keys
            or type(self.loss).critic_output is not ActorCriticLoss.critic_output
            or any(
                vars(each)[kind]
                for each in (network, module, *module)
                for kind in HOOKS
            )
        ):
            return None
        norms = [each for each in module if type(each) is nn.LayerNorm]
        linear = [each for each in module if type(each) is nn.Linear]
        hidden = [nn.Linear, *[nn.LayerNorm] * bool(norms), nn.ReLU]
        widths = [(each.out_features,) for each in linear][: len(norms)]
        is_plain = (
            len(linear) > 1
            and list(map(type, module)) == [*hidden * (len(linear) - 1), nn.Linear]
            and linear[-1].out_features == 1
            and [each.normalized_shape for each in norms] == widths
            and not any(None in (each.weight, each.bias) for each in (*linear, *norms))
        )
        return [each.eps for each in norms] if is_plain else None

    def _layers(self, params: TensorDictBase) -> Layers:
        layers: Layers = []
        for name, each in self.loss.qvalue_network.module.named_children():
            if type(each) is not nn.ReLU:
                own = params["module", name]
                if type(each) is nn.Linear:
                    layers.append(())
                layers[-1] += own["weight"], own["bias"]
        return layers

    def _state(self, states: TensorDictBase) -> Any:
        return states.get(self.loss.qvalue_network.in_keys[0])


def fuse_critics(loss: nn.Module) -> None:
    """Let a loss, and the losses in it, evaluate their critics by this module."""
    for each in loss.modules():
        if isinstance(each, ActorCriticLoss) and type(each.critics) is Critics:
            each.critics = FusedCritics(each)


def _values(layers: Layers, eps: Sequence[float], rows: Tensor) -> Tensor:
    """Return the critics' values ``[N, ...]`` of pairs ``[..., S + A]``."""
    batch, number = rows.shape[:-1], len(layers[0][1])
    hidden = rows.reshape(-1, rows.shape[-1]).expand(number, -1, -1)
    for index, (weight, bias, *norm) in enumerate(layers):
        hidden = torch.baddbmm(bias.unsqueeze(1), hidden, weight.mT)
        if norm and number == 1:
            scale, shift = (each.squeeze(0) for each in norm)
            # Half precision would also add up the rows' gradients by scale and shift.
            hidden = hidden.to(scale.dtype)
            hidden = layer_norm(hidden, scale.shape, scale, shift, eps[index])
        elif norm:
            # layer_norm takes one scale and shift for all critics. Ones and zeros stand
            # in: without them torch 2.13 takes twice as long.
            ones = norm[0].new_ones(hidden.shape[-1])
            zeros = torch.zeros_like(ones)
            hidden = layer_norm(hidden, ones.shape, ones, zeros, eps[index])
            scale, shift = (each.unsqueeze(1) for each in norm)
            hidden = torch.addcmul(shift, hidden, scale)
        if index < len(layers) - 1:
            hidden = hidden.relu_()
    # Under autocast the layers compute in half precision; what follows does not.
    return hidden.reshape(-1, *batch).to(rows.dtype)


class _SoftMaximum(torch.autograd.Function):
    """Compute :func:`~torchrl_osr.functional.soft_maximum` of values, ``[N, B]``.

    Differentiable by the critics' parameters, once. If all rows weigh ``alike`` in the
    loss, as in a mean or a sum, the forward pass computes the gradient, too. Otherwise
    the backward pass computes the chunks once more.
    """

    @staticmethod
    def forward(ctx: Any, alike: bool, given: tuple[Any, ...], *flat: Tensor) -> Tensor:
        ctx.alike, ctx.given, ctx.flat = alike, given, flat
        ones = flat[0].new_ones(len(flat[0]), given[-1].shape[1]) if alike else None
        value, gradient = _evaluate(ones, flat, *given)
        ctx.save_for_backward(*gradient)
        return value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Any:
        # Not torch's once_differentiable: it objects only where the upstream gradient
        # has a gradient itself, unlike the one of a mean.
        if torch.is_grad_enabled():
            raise RuntimeError("Fused critics have no second derivatives.")
        if ctx.alike:
            weight = upstream.flatten()[0]
            equal = (upstream == weight).all() | weight.isnan()  # NaN is no equal
            torch._assert_async(equal, "The rows of the loss do not weigh alike.")
            gradient = list(torch._foreach_mul(ctx.saved_tensors, weight))
        else:
            _, gradient = _evaluate(upstream, ctx.flat, *ctx.given)
        return (None, None, *gradient)


def _evaluate(
    weights: Tensor | None,
    flat: Sequence[Tensor],
    sizes: list[int],
    eps: Sequence[float],
    temperature: float,
    dtype: torch.dtype | None,
    state: Tensor,
    action: Tensor,
    log_prob: Tensor,
) -> tuple[Tensor, list[Tensor]]:
    """Return the values, and the gradient of their sum with these weights, if any."""
    number, chunk = len(flat[0]), max(1, CHUNK_ROWS // len(action))
    value = log_prob.new_empty(number, len(state))
    gradient = [torch.zeros_like(each) for each in flat]
    for critic in range(number):
        own = [each.detach()[critic : critic + 1].requires_grad_() for each in flat]
        totals, parts = [each[critic : critic + 1] for each in gradient], iter(own)
        layers = [tuple(next(parts) for _ in range(size)) for size in sizes]
        for start in range(0, len(state), chunk):
            rows = slice(start, start + chunk)
            pairs = state[rows].expand(len(action), -1, -1), action[:, rows]
            with torch.set_grad_enabled(weights is not None):
                with torch.autocast("cpu", dtype, enabled=dtype is not None):
                    found = _values(layers, eps, torch.cat(pairs, -1)).squeeze(0)
                logits = found / temperature - log_prob[:, rows]
                soft = temperature * logits.logsumexp(0)
            if weights is not None:
                more = torch.autograd.grad(soft, own, weights[critic, rows])
                torch._foreach_add_(totals, more)
            value[critic, rows] = soft.detach()
    return value, gradient
