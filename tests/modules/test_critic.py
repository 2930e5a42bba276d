"""Critics: values, initialisation, and layer normalisation."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr import OSRLoss
from torchrl_osr.modules import (
    critic_ensemble,
    discrete_critic_ensemble,
    state_value,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)


@pytest.mark.parametrize("count", [1, 10])
def test_critics_score_actions_and_differ(count) -> None:
    batch = TensorDict({"observation": torch.randn(4, 5)}, [4])
    batch["action"] = torch.rand(4, 2)
    options = {"num_qvalue_nets": count, "num_cells": [8]}
    for build, key, shape in (
        (critic_ensemble, "state_action_value", (4, 1)),
        (discrete_critic_ensemble, "action_value", (4, 2)),
    ):
        values = [each(batch.clone())[key] for each in build(5, 2, **options)]
        assert [value.shape for value in values] == [shape] * count
        assert torch.stack(values).unique(dim=0).shape[0] == count
    assert state_value(5, num_cells=[8])(batch)["state_value"].shape == (4, 1)


def test_critics_keep_torchs_default_initialisation_in_the_loss() -> None:
    # torch.nn.Linear draws uniformly within +-1/sqrt(fan in). TorchRL's own copies of
    # one network are drawn between the extremes of each tensor instead.
    torch.manual_seed(3)
    critics = critic_ensemble(5, 2, num_cells=[400])
    torch.manual_seed(3)
    for critic in critics:
        for name, layer in (
            ("0", torch.nn.Linear(7, 400)),
            ("2", torch.nn.Linear(400, 1)),
        ):
            weight = critic.module.get_parameter(f"{name}.weight")
            assert torch.equal(weight, layer.weight)
    actor = tanh_gaussian_actor(5, 2, num_cells=[8])
    model = tanh_gaussian_inverse_dynamics(5, 2, num_cells=[8])
    loss = OSRLoss(actor, critics, model)
    weight = loss.qvalue_network_params["module", "2", "weight"]
    for kept, critic in zip(weight, critics, strict=True):
        assert torch.equal(kept, critic.module[2].weight)
