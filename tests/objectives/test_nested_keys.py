"""Renamed and nested keys from the builders to the optimizer step."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, unravel_key
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_osr import (
    DiscreteOSRLoss,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StatePerturbation,
)
from torchrl_osr.lab.losses import TD3BCLoss
from torchrl_osr.modules import (
    categorical_actor,
    categorical_inverse_dynamics,
    critic_ensemble,
    cvae_inverse_dynamics,
    deterministic_actor,
    discrete_critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

CELLS = {"num_cells": [8]}
ROWS = 24
NAMES = {
    "default": ("observation", "action"),
    "flat": ("obs", "act"),
    "nested": (("agent", "obs"), ("agent", "act")),
    "deep": (("agents", "0", "obs"), ("agents", "0", "act")),
}
KINDS = {
    "osr": (OSRLoss, tanh_gaussian_inverse_dynamics),
    "osr-cvae": (OSRLoss, cvae_inverse_dynamics),
    "osr-v": (OSRVLoss, tanh_gaussian_inverse_dynamics),
    "discrete": (DiscreteOSRLoss, categorical_inverse_dynamics),
    "td3-bc": (TD3BCLoss, None),
}


def make_buffer(observation, action, discrete: bool) -> TensorDictReplayBuffer:
    """The same rows and the same draws under any names."""
    generator = torch.Generator().manual_seed(0)
    state, following = torch.randn(2, ROWS, 3, generator=generator)
    taken = 1.8 * torch.rand(ROWS, 2, generator=generator) - 0.9
    if discrete:
        taken = nn.functional.one_hot(taken.argmax(-1), 2)
    data = TensorDict({}, [ROWS])
    data[observation], data[action] = state, taken
    data[unravel_key(("next", observation))] = following
    data["next", "reward"] = torch.randn(ROWS, 1, generator=generator)
    for key in ("done", "terminated"):
        data["next", key] = torch.zeros(ROWS, 1, dtype=torch.bool)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(ROWS),
        batch_size=8,
        generator=torch.Generator().manual_seed(1),
        transform=StatePerturbation(0.1, in_keys=[observation], seed=2),
    )
    buffer.extend(data)
    return buffer


def step(loss, buffer) -> None:
    """One optimizer step on everything the loss trains."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    out = loss(buffer.sample())
    sum(out[key] for key in out.keys() if key.startswith("loss_")).backward()  # noqa: SIM118
    optimizer.step()


def train(kind: str, names: str) -> list[torch.Tensor]:
    """Weights after a step of each loss."""
    loss_class, build = KINDS[kind]
    observation, action = NAMES[names]
    keys = {"observation_key": observation, "action_key": action}
    discrete = kind == "discrete"
    torch.manual_seed(3)
    buffer, models = make_buffer(observation, action, discrete), []
    if build is not None:
        models = [build(3, 2, **CELLS, **keys)]
        fit = InverseDynamicsLoss(*models)
        fit.set_keys(action=action)
        step(fit, buffer)
    if discrete:
        actor = categorical_actor(3, 2, **CELLS, **keys)
        critics = discrete_critic_ensemble(3, 2, **CELLS, observation_key=observation)
    else:
        policy = deterministic_actor if kind == "td3-bc" else tanh_gaussian_actor
        actor = policy(3, 2, **CELLS, **keys)
        critics = critic_ensemble(3, 2, **CELLS, **keys)
    loss = loss_class(actor, critics, *models)
    loss.set_keys(action=action)
    updater = SoftUpdate(loss, tau=0.1)
    step(loss, buffer)
    updater.step()
    acted = actor(buffer.sample().exclude(action))
    assert acted[action].shape == (8, 2)
    return [*loss.parameters(), *loss.buffers(), acted[action].detach()]


@pytest.mark.parametrize("kind", KINDS)
def test_the_names_change_nothing(kind, assert_same_bits) -> None:
    expected = train(kind, "default")
    assert len(expected) > 10
    for names in ("flat", "nested", "deep"):
        assert_same_bits(train(kind, names), expected)
