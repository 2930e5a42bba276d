"""Small data for dynamics models."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import LazyTensorStorage

from torchrl_osr.lab.dynamics import ModelData


@pytest.fixture
def data(transitions) -> ModelData:
    storage = LazyTensorStorage(540)
    storage.set(range(540), transitions(540, observation=11, action=3))
    held_out = transitions(60, observation=11, action=3, seed=8)
    loc, scale = torch.zeros(11), torch.full([11], 0.1)
    loc[0] = 1.2  # upright
    return ModelData(
        storage, held_out, loc, scale, reward_scale=2.0, gamma=0.99,
        env_id="Hopper-v5", seed=0,
    )  # fmt: skip
