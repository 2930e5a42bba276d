"""Many rows through the critics, a few states at a time: the fast path on a CPU.

The critics score 3K + 1 actions of every state. All at once, each layer writes and
reads again activations of many megabytes, which go through memory and are given back to
the operating system at every step; a few states at a time they stay in the cache. So
value and gradient are computed together, chunk by chunk, and only the gradient is kept.

Shapes: ``B`` rows, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

ROWWISE = (
    nn.Linear, nn.LayerNorm, nn.Identity, nn.ReLU, nn.LeakyReLU, nn.ELU, nn.GELU,
    nn.SiLU, nn.Mish, nn.Softplus, nn.Tanh, nn.Sigmoid,
)  # fmt: skip
"""Layers whose output for one row depends on that row alone, without a random draw."""

Rows = Callable[[TensorDictParams, slice], Tensor]
"""Maps parameters and a slice of the rows to a number a critic and row, ``[N, b]``."""


def is_rowwise(network: nn.Module) -> bool:
    """Return whether a network may be given its rows a few at a time.

    Dropout and batch normalisation may not: their results depend on the other rows or
    on a draw. What is not known is taken for one of these.
    """
    layers = (module for module in network.modules() if not any(module.children()))
    return all(isinstance(layer, ROWWISE) for layer in layers)


def chunked(
    rows: Rows, params: TensorDictParams, number: int, chunk_size: int
) -> Tensor:
    """Return ``rows`` of all ``number`` rows, ``[N, B]``, differentiable by ``params``.

    The gradient is exact for every use of the result. It costs nothing more where all
    numbers weigh the same, as in a mean or a sum; otherwise, with masks or importance
    weights, the chunks are computed once more with the weights that they have.

    Args:
        rows: evaluates a chunk.
        params: the critics' parameters.
        number: of rows, ``B``.
        chunk_size: rows of a chunk.
    """
    leaves = [leaf for leaf in params.values(True, True) if leaf.requires_grad]
    result: Tensor = _Chunked.apply(  # type: ignore[no-untyped-call]
        rows, params, number, chunk_size, *leaves
    )
    return result


def _evaluate(
    rows: Rows,
    params: TensorDictParams,
    number: int,
    chunk_size: int,
    weight: Tensor | None = None,
) -> tuple[Tensor, list[Tensor]]:
    """Return the values ``[N, B]`` and the gradient of their (weighted) sum."""
    local = params.apply(lambda leaf: leaf.detach().requires_grad_(leaf.requires_grad))
    leaves = [leaf for leaf in local.values(True, True) if leaf.requires_grad]
    values: list[Tensor] = []
    total: list[Tensor] = []
    for start in range(0, number, chunk_size):
        chunk = slice(start, start + chunk_size)
        with torch.enable_grad():
            value = rows(local, chunk)
        upstream = torch.ones_like(value) if weight is None else weight[:, chunk]
        gradient = torch.autograd.grad(value, leaves, upstream)
        if total:
            torch._foreach_add_(total, gradient)
        else:
            total = list(gradient)
        values.append(value.detach())
    return torch.cat(values, 1), total


class _Chunked(torch.autograd.Function):
    @staticmethod
    @torch.amp.custom_fwd(device_type="cpu")
    def forward(ctx: Any, *arguments: Any) -> Any:
        # The leaves come last: only what is an argument can receive a gradient.
        rows, params, number, chunk_size, *_leaves = arguments
        ctx.arguments = (rows, params, number, chunk_size)
        values, gradient = _evaluate(rows, params, number, chunk_size)
        ctx.save_for_backward(*gradient)
        return values

    @staticmethod
    @once_differentiable
    @torch.amp.custom_bwd(device_type="cpu")
    def backward(ctx: Any, upstream: Tensor) -> Any:  # type: ignore[override]
        weight = upstream.flatten()[0]
        if bool((upstream == weight).all()):
            gradient = list(torch._foreach_mul(ctx.saved_tensors, weight))
        else:
            rows, params, number, chunk_size = ctx.arguments
            _, gradient = _evaluate(rows, params, number, chunk_size, upstream)
        return (None, None, None, None, *gradient)
