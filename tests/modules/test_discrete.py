"""Networks for discrete actions: shapes, what they read, and TorchRL's environments."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv
from torchrl.modules import OneHotCategorical

from torchrl_osr.modules import (
    categorical_actor,
    categorical_inverse_dynamics,
    discrete_critic_ensemble,
)

BUILDERS = [categorical_actor, categorical_inverse_dynamics]


def states(*size: int) -> TensorDict:
    observation, next_observation = torch.randn(2, *size, 5)
    next_states = {"observation": next_observation}
    return TensorDict({"observation": observation, "next": next_states}, size)


@pytest.mark.parametrize("build", BUILDERS)
@pytest.mark.parametrize("size", [(7,), (2, 3)])
def test_actions_are_one_hot_with_their_log_probability(build, size) -> None:
    network = build(5, 3, num_cells=[8])
    out = network(states(*size))
    assert out["logits"].shape == out["action"].shape == (*size, 3)
    assert (out["action"].sum(-1) == 1).all()
    policy = network.get_dist(out)
    assert type(policy) is OneHotCategorical
    torch.testing.assert_close(out["action_log_prob"], policy.log_prob(out["action"]))


def test_model_reads_both_states_and_the_policy_only_the_first() -> None:
    before = states(4)
    after = before.clone()
    after["next", "observation"] += 1
    moved = [
        not torch.equal(network.get_dist(before).logits, network.get_dist(after).logits)
        for network in (build(5, 3, num_cells=[8]) for build in BUILDERS)
    ]
    assert moved == [False, True]


@pytest.mark.parametrize("count", [1, 2, 10])
def test_critics_value_all_actions_and_differ(count) -> None:
    critics = discrete_critic_ensemble(5, 3, num_qvalue_nets=count, num_cells=[8])
    batch = states(4)
    values = [critic(batch.clone())["action_value"] for critic in critics]
    assert [value.shape for value in values] == [(4, 3)] * count
    assert torch.stack(values).unique(dim=0).shape[0] == count


@pytest.mark.parametrize("build", [*BUILDERS, discrete_critic_ensemble])
def test_width_depth_and_activation_are_as_asked(build) -> None:
    network = build(5, 3, num_cells=[6, 4], activation_class=torch.nn.Tanh)
    network = network[0] if isinstance(network, list) else network
    layers = [m for m in network.modules() if isinstance(m, torch.nn.Linear)]
    assert [layer.out_features for layer in layers] == [6, 4, 3]
    assert sum(isinstance(m, torch.nn.Tanh) for m in network.modules()) == 2


def test_actor_plays_a_gymnasium_task_as_torchrl_gives_it() -> None:
    env = GymEnv("CartPole-v1")
    rollout = env.rollout(5, categorical_actor(4, 2, num_cells=[8]))
    assert env.action_spec.is_in(rollout["action"][0].to(env.action_spec.dtype))
    env.close()
