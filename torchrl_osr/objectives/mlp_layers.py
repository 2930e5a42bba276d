"""Which critics are plain MLPs, and where the parameters of their layers lie.

Shapes: ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP


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


def plain_mlp(network: TensorDictModuleBase, action_key: NestedKey) -> PlainMLP | None:
    """Return the names of a plain MLP's layers, or ``None`` for another network.

    Plain is a :class:`~torchrl.modules.MLP` with one output that reads observations and
    then the action, of linear layers and ReLUs in between; before the ReLUs there may
    be layer normalisations. All of them have a weight and a bias, and nobody has put a
    hook on them.

    It takes microseconds and is not kept: hooks and layers may come and go.
    """
    module: Any = getattr(network, "module", None)
    if type(module) is not MLP or network.in_keys[-1] != action_key:
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
