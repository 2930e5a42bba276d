"""A dynamics model that is a cart, exactly: what it predicts is known by hand."""

from __future__ import annotations

import torch

from torchrl_osr.lab.dynamics import DynamicsEnsemble


def cart(*bias: float, elites: int = 1, step: float = 1.0) -> DynamicsEnsemble:
    """Position and velocity ``[x, v]``; the action accelerates, a bias pushes.

    One network for each bias, by default one without. ``x`` rises by ``v`` and ``v`` by
    the action, ``step`` times each; the reward is ``v`` before that.
    """
    bias = bias or (0.0,)
    model = DynamicsEnsemble(
        2, 1, num_networks=len(bias), num_elites=elites, num_cells=[]
    )
    (layer,) = model.layers
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        layer.weight[:, 1, 0] = layer.weight[:, 2, 1] = step
        layer.weight[:, 1, 2] = 1.0
        layer.bias[:, 0, 1] = torch.tensor(bias)
    return model
