"""Dynamics models whose predictions can be computed by hand."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_osr.lab.dynamics import DynamicsEnsemble


def uneven_dynamics() -> DynamicsEnsemble:
    """Three networks, of which the first and the last are the elites, in float64.

    Every number that could be mixed up is another one.
    """
    torch.manual_seed(4)
    model = DynamicsEnsemble(3, 2, num_networks=3, num_elites=2, num_cells=[6])
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    model.elites.copy_(torch.tensor([0, 2]))
    model.target_scale.uniform_(0.5, 2)
    model.input_loc.normal_()
    return model.double()


def plain_gaussian(
    model: DynamicsEnsemble, number: int, state: Tensor, action: Tensor
) -> tuple[Tensor, Tensor]:
    """One network's mean and variance of the standardised target, layer by layer."""
    hidden = (torch.cat([state, action]) - model.input_loc) / model.input_scale
    for layer in model.layers[:-1]:
        hidden = layer.weight[number].T @ hidden + layer.bias[number, 0]
        hidden = hidden * torch.sigmoid(hidden)
    last = model.layers[-1]
    out = last.weight[number].T @ hidden + last.bias[number, 0]
    mean, free = out.chunk(2)
    low, high = model.lowest_log_variance, model.highest_log_variance
    free = high - torch.log(1 + torch.exp(high - free))
    return mean, torch.exp(low + torch.log(1 + torch.exp(free - low)))


def compare_models(check, label: str, *pairs: tuple[Tensor, nn.Module]) -> None:
    """Compare losses, each with its model, and the gradients of their means."""
    found = (
        [loss.detach(), *torch.autograd.grad(loss.mean(), [*model.parameters()])]
        for loss, model in pairs
    )
    check(label, *found, tolerance=1e-10)


def linear_dynamics(
    sizes: tuple[int, int],
    weights: dict[tuple[int, int], float],
    networks: tuple[int, int],
    log_variance: float = -40.0,
) -> DynamicsEnsemble:
    """Networks and elites without hidden layers, zero but for some weights.

    ``weights`` lead from an input (state, action) to an output (change, reward).
    """
    counts = dict(zip(("num_networks", "num_elites"), networks, strict=True))
    model = DynamicsEnsemble(*sizes, **counts, num_cells=[])
    layer = model.layers[0].requires_grad_(False)
    layer.weight.zero_()
    for (start, end), weight in weights.items():
        layer.weight[:, start, end] = weight
    layer.bias[..., sizes[0] + 1 :] = log_variance
    # Bounds far apart do not bend what lies between them.
    model.lowest_log_variance.data.fill_(-60)
    model.highest_log_variance.data.fill_(60)
    return model
