"""Critics: their initialisation."""

from __future__ import annotations

import torch
from objectives.losses import A, S

from torchrl_osr.modules import critic_ensemble


def test_critics_have_torchs_default_initialisation() -> None:
    # torch.nn.Linear draws uniformly within +-1/sqrt(fan in). TorchRL's own copies of
    # one network are drawn between the extremes of each tensor instead.
    torch.manual_seed(3)
    critics = critic_ensemble(S, A, num_cells=[400])
    torch.manual_seed(3)
    for critic in critics:
        layers = torch.nn.Linear(S + A, 400), torch.nn.Linear(400, 1)
        for name, layer in zip("02", layers, strict=True):
            weight = critic.module.get_parameter(f"{name}.weight")
            assert torch.equal(weight, layer.weight)
