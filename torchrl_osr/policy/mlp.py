"""Multi-layer perceptrons described in JSON, and built from such a description."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn
from torchrl.modules import MLP

from torchrl_osr._checks import check_choice

ACTIVATIONS = ("ELU", "GELU", "LeakyReLU", "ReLU", "SiLU", "Tanh")
"""Classes of :mod:`torch.nn` that are allowed between the layers."""

MAX_SIZE, MAX_LAYERS = 2**20, 64  # a file may come from anybody


def describe_mlp(mlp: MLP) -> dict[str, Any]:
    """JSON-compatible description of a network, without its weights."""
    return {
        "num_cells": list(mlp.num_cells),
        "activation": getattr(mlp.activation_class, "__name__", ""),
        "layer_norm": mlp.norm_class is nn.LayerNorm,
    }


def build_mlp(description: Mapping[str, Any], inputs: int, outputs: int) -> MLP:
    """Network on the device ``"meta"``: it takes no memory until weights are assigned.

    Args:
        description: see :func:`describe_mlp`.
        inputs, outputs: sizes of the first and the last layer.

    Raises:
        ValueError: naming what is unknown or out of bounds.
    """
    cells, layer_norm = description["num_cells"], description["layer_norm"]
    check_choice("activation", description["activation"], ACTIVATIONS)
    check_choice("layer_norm", layer_norm, (False, True))
    if not isinstance(cells, list) or len(cells) > MAX_LAYERS:
        raise ValueError(f"num_cells must list up to {MAX_LAYERS} widths.")
    for width in cells:
        check_size("num_cells", width)
    norm: dict[str, Any] = {
        "norm_class": nn.LayerNorm,
        "norm_kwargs": [{"normalized_shape": width} for width in cells],
    }
    with torch.device("meta"):
        return MLP(
            in_features=inputs,
            out_features=outputs,
            num_cells=cells,
            activation_class=getattr(nn, description["activation"]),
            **(norm if layer_norm else {}),
        )


def check_size(name: str, value: Any, least: int = 1, most: int = MAX_SIZE) -> int:
    """The value, which must be a whole number within bounds."""
    if type(value) is not int or not least <= value <= most:
        raise ValueError(
            f"{name} must be from {least} to {most}, got {str(value)[:40]}."
        )
    return value
