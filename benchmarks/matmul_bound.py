"""The matrix products of an OSR update, and nothing else of it.

No update of these networks in this precision can be faster than its products: forward,
and backward by the inputs and by the weights. Shapes come from the layer sizes; every
tensor is allocated once and written in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import torch
from torch.utils.flop_counter import FlopCounterMode

aten = torch.ops.aten
# What PyTorch's own counter has no numbers for: products by the shapes of the factors.
MORE_FLOPS = {
    aten.addmm_: lambda _, a, b, **__: 2 * a[0] * a[1] * b[1],
    aten.mv: lambda a, _, **__: 2 * a[0] * a[1],
    aten.addmv_: lambda _, a, __, **___: 2 * a[0] * a[1],
}


class NoModules:
    """Stands for the counter's tracker of modules, which fails on TensorDictParams."""

    parents = frozenset({"Global"})

    def __enter__(self) -> None:
        """Watch nothing."""

    def __exit__(self, *_: object) -> None:
        """Watch nothing."""


def count_flops(update: Callable[[], Iterable[str]]) -> int:
    """Floating point operations of the matrix products of one update."""
    counter = FlopCounterMode(display=False, custom_mapping=MORE_FLOPS)
    counter.mod_tracker = NoModules()
    with counter:
        for _ in update():
            pass
    return counter.get_total_flops()


@dataclass(frozen=True)
class Pass:
    """One network on some rows.

    Args:
        widths: of the input, the hidden layers and the output.
        rows: how many there are.
        pieces: the rows of each call, when they go through the network in pieces.
        copies: networks of this kind, each on all rows.
        by_weight: whether the gradient by the weights is computed.
        by_input: whether the gradient by the network's input is computed.
    """

    widths: tuple[int, ...]
    rows: int
    pieces: tuple[int, ...] = ()
    copies: int = 1
    by_weight: bool = False
    by_input: bool = False

    def flops(self) -> int:
        """Floating point operations, two for each multiplication."""
        layers = list(pairwise(self.widths))
        forward = sum(inputs * outputs for inputs, outputs in layers)
        total = forward * (1 + self.by_weight)
        if self.by_weight or self.by_input:
            # The first layer's input is data, unless an action has a gradient.
            first = 0 if self.by_input else layers[0][0] * layers[0][1]
            total += forward - first
        return 2 * self.rows * self.copies * total


def total_flops(passes: Sequence[Pass]) -> int:
    """Floating point operations of all passes."""
    return sum(each.flops() for each in passes)


def osr_passes(
    observations: int,
    actions: int,
    cells: Sequence[int],
    *,
    batch: int = 256,
    num_random: int = 10,
    critics: int = 2,
    chunk: int | None = None,
) -> list[Pass]:
    """Passes of an update of ``OSRLoss``.

    Args:
        observations, actions: sizes of a state and of an action.
        cells: widths of the hidden layers of all networks.
        batch: rows of a batch.
        num_random: ``K``, actions drawn of each kind.
        critics: how many.
        chunk: states that the critics take at a time with all their sampled actions,
            which share the first layer's product with the state; ``None`` for all rows.
    """
    actor = (observations, *cells, 2 * actions)
    inverse_dynamics = (2 * observations, *cells, 2 * actions)
    critic = (observations + actions, *cells, 1)
    sampled = 3 * num_random
    # s, s' and s^; the policy's values, the target's, the inverse dynamics on s and s^.
    passes = [
        Pass(actor, 3 * batch, by_weight=True),
        Pass(critic, 2 * batch, copies=critics, by_input=True),
        Pass(critic, batch, copies=critics),
        Pass(inverse_dynamics, 2 * batch),
    ]
    learning = partial(Pass, copies=critics, by_weight=True)
    if chunk is None:
        return [*passes, learning(critic, (sampled + 1) * batch)]
    states = tuple(min(chunk, batch - start) for start in range(0, batch, chunk))
    rows = tuple(sampled * number for number in states)
    apart = learning((observations, cells[0]), batch, pieces=states)
    together = learning((actions, *cells, 1), sampled * batch, pieces=rows)
    return [*passes, learning(critic, batch), apart, together]


class Products:
    """The products of the passes, on tensors of their own.

    Args:
        passes: see :func:`osr_passes`.
        dtype, device: of all tensors.
    """

    def __init__(
        self, passes: Sequence[Pass], dtype: torch.dtype, device: torch.device | str
    ) -> None:
        like = {"dtype": dtype, "device": device}
        self.work = []
        for each in passes:
            # Pieces share their tensors, as freed memory is used again.
            rows = max(each.pieces, default=each.rows)
            values = [torch.randn(rows, width, **like) for width in each.widths]
            gradients = [torch.randn(rows, width, **like) for width in each.widths]
            for _ in range(each.copies):
                # Scaled, so that numbers neither grow nor vanish over the layers.
                weights = [
                    torch.randn(outputs, inputs, **like) * inputs**-0.5
                    for inputs, outputs in pairwise(each.widths)
                ]
                by_weight = [torch.empty_like(weight) for weight in weights]
                tensors = (values, gradients, weights, by_weight)
                self.work.append((each, tensors))

    @torch.no_grad()
    def update(self, *_: object) -> Iterator[str]:
        """Do all products once."""
        for each, tensors in self.work:
            values, gradients, weights, by_weight = tensors
            for rows in each.pieces or (each.rows,):
                x = [value[:rows] for value in values]
                g = [gradient[:rows] for gradient in gradients]
                for i, weight in enumerate(weights):
                    torch.mm(x[i], weight.t(), out=x[i + 1])
                for i in reversed(range(len(weights))):
                    if each.by_weight:
                        torch.mm(g[i + 1].t(), x[i], out=by_weight[i])
                    if each.by_input or (i > 0 and each.by_weight):
                        torch.mm(g[i + 1], weights[i], out=g[i])
        yield "products"
