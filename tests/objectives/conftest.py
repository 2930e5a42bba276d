"""Small networks and transitions with discrete actions."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict, unravel_key
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP, OneHotCategorical, ProbabilisticActor

NUM_ACTIONS = 4


@pytest.fixture
def make_discrete_networks():
    """Return a factory of a categorical actor, critics and model, float64.

    Built from TorchRL alone, with any keys; equal seeds give equal weights.
    """

    def make(
        *,
        observation="observation",
        action="action",
        num_critics: int = 2,
        seed: int = 0,
        distribution_class: type = OneHotCategorical,
        num_actions: int = NUM_ACTIONS,
        num_model_actions: int = NUM_ACTIONS,
        num_critic_actions: int = NUM_ACTIONS,
    ) -> SimpleNamespace:
        torch.manual_seed(seed)

        def probabilistic(number: int, *inputs) -> ProbabilisticActor:
            network = MLP(len(inputs) * 3, number, num_cells=[8])
            return ProbabilisticActor(
                TensorDictModule(network, list(inputs), ["logits"]),
                in_keys=["logits"],
                out_keys=[action],
                distribution_class=distribution_class,
            ).double()

        following = unravel_key(("next", observation))
        return SimpleNamespace(
            actor=probabilistic(num_actions, observation),
            critics=[
                TensorDictModule(
                    MLP(3, num_critic_actions, num_cells=[8]),
                    [observation],
                    ["action_value"],
                ).double()
                for _ in range(num_critics)
            ],
            inverse_dynamics=probabilistic(num_model_actions, observation, following),
        )

    return make


@pytest.fixture
def make_discrete_batch(make_batch):
    """Return a factory of ``make_batch``'s transitions with one-hot actions."""

    def make(*size: int, twin: bool = True) -> TensorDict:
        batch = make_batch(*size, twin=twin)
        generator = torch.Generator().manual_seed(8)
        index = torch.randint(NUM_ACTIONS, size, generator=generator)
        batch["action"] = torch.nn.functional.one_hot(index, NUM_ACTIONS)
        return batch

    return make
