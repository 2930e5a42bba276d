from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
import torch

from torchrl_osr.lab.data import (
    collect_transitions,
    load_behavior_policy,
    make_environment,
)
from torchrl_osr.lab.data.behavior import BehaviorPolicy, load_behavior_card

CARD = load_behavior_card()
ALL_POLICIES = [(env, name) for env in CARD for name in CARD[env]["policies"]]


def torch_network(policy: BehaviorPolicy) -> torch.nn.Sequential:
    """Restate the network with torch layers: outputs [mean, log_std]."""
    head_size = 2 * policy.mean.weight.shape[0]
    network = torch.nn.Sequential(
        torch.nn.Linear(policy.hidden0.weight.shape[1], 256),
        torch.nn.ReLU(),
        torch.nn.Linear(256, 256),
        torch.nn.ReLU(),
        torch.nn.Linear(256, head_size),
    )
    heads = [
        np.concatenate(parts) for parts in zip(policy.mean, policy.log_std, strict=True)
    ]
    layers = [policy.hidden0, policy.hidden1, heads]
    for linear, (weight, bias) in zip(network[::2], layers, strict=True):
        linear.weight.data = torch.from_numpy(weight)
        linear.bias.data = torch.from_numpy(bias)
    return network


@pytest.mark.parametrize(("env_name", "policy_name"), ALL_POLICIES)
def test_forward_pass_agrees_with_torch(env_name: str, policy_name: str) -> None:
    policy = load_behavior_policy(env_name, policy_name)
    with closing(make_environment(CARD[env_name]["env"])) as env:
        data, *_ = collect_transitions(env, [policy.sample], 64, progress=False)
    observation = data["observation"].numpy()
    with torch.no_grad():
        outputs = torch_network(policy)(data["observation"])
    mean, log_std = outputs.chunk(2, dim=-1)
    noise = np.random.default_rng(1).standard_normal(mean.shape, dtype=np.float32)
    sampled = torch.tanh(mean + log_std.clamp(-20, 2).exp() * torch.from_numpy(noise))
    np.testing.assert_allclose(
        policy.deterministic(observation), mean.tanh().numpy(), rtol=0, atol=5e-6
    )
    np.testing.assert_allclose(
        policy.sample(observation, np.random.default_rng(1)),
        sampled.numpy(),
        rtol=0,
        atol=5e-6,
    )
