"""Small policies of each kind."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torchrl.envs import ObservationNorm

from torchrl_osr import CQLLoss, DiscreteOSRLoss, modules
from torchrl_osr.lab.losses import TD3BCLoss
from torchrl_osr.policy import Policy, policy_from_loss

STATE, ACTION = 3, 2
LOW, HIGH = [-2.0, 0.5], [4.0, 1.5]


@pytest.fixture(scope="session")
def make_loss() -> Callable[..., torch.nn.Module]:
    """Return a factory of losses with untrained networks: osr, td3_bc or discrete."""

    def make(kind: str, num_qvalue_nets: int = 2, layer_norm: bool = False):
        torch.manual_seed(1)
        cells = {"num_cells": [8, 4]}
        many = cells | {"num_qvalue_nets": num_qvalue_nets}
        if kind == "discrete":
            actor = modules.categorical_actor(STATE, ACTION, **cells)
            critics = modules.discrete_critic_ensemble(STATE, ACTION, **many)
            return DiscreteOSRLoss(actor, critics, recovery_weight=0)
        critics = modules.critic_ensemble(STATE, ACTION, layer_norm=layer_norm, **many)
        if kind == "td3_bc":
            actor = modules.deterministic_actor(STATE, ACTION, **cells)
            return TD3BCLoss(actor, critics)
        actor = modules.tanh_gaussian_actor(STATE, ACTION, **cells)
        return CQLLoss(actor, critics)

    return make


@pytest.fixture(scope="session")
def make_policy(make_loss) -> Callable[..., Policy]:
    """Return a factory of policies of those losses, with bounds of their own."""
    norm = ObservationNorm(
        torch.tensor([1.0, -2.0, 0.0]), torch.tensor([2.0, 0.5, 1.0]),
        in_keys=["observation"], standard_normal=True,
    )  # fmt: skip

    def make(kind: str, **options) -> Policy:
        bounds = {} if kind == "discrete" else {"low": LOW, "high": HIGH}
        source = {"env_id": "Task-v0", "step": 7}
        loss = make_loss(kind, **options)
        return policy_from_loss(loss, norm, **bounds, source=source)

    return make
