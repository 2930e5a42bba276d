"""A dynamics model in which every number that could be mixed up is another one."""

from __future__ import annotations

import torch
from torch import nn

from torchrl_osr.lab.dynamics import DynamicsEnsemble


def uneven_dynamics() -> DynamicsEnsemble:
    """Three networks, of which the first and the last are the elites, in float64."""
    torch.manual_seed(4)
    model = DynamicsEnsemble(3, 2, num_networks=3, num_elites=2, num_cells=[6])
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    model.elites.copy_(torch.tensor([0, 2]))
    model.target_scale.uniform_(0.5, 2)
    model.input_loc.normal_()
    return model.double()
