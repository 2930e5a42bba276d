from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from torchrl_osr.lab.data import (
    collect_transitions,
    load_behavior_policy,
    make_environment,
)
from torchrl_osr.lab.data.behavior import load_behavior_card

CARD = load_behavior_card()


@pytest.mark.parametrize("env_name", CARD)
def test_forward_pass_agrees_with_torch(env_name: str) -> None:
    policy = load_behavior_policy(env_name, "expert")
    with closing(make_environment(CARD[env_name]["env"])) as env:
        data, *_ = collect_transitions(env, [policy.sample], 64, progress=False)
    arrays = {name: torch.from_numpy(each) for name, each in policy.arrays.items()}
    first, second, *heads = (
        [arrays[f"{layer}.weight"], arrays[f"{layer}.bias"]]
        for layer in ("hidden0", "hidden1", "mean", "log_std")
    )
    hidden = F.linear(F.linear(data["observation"], *first).relu(), *second).relu()
    mean, log_std = (F.linear(hidden, *head) for head in heads)
    noise = np.random.default_rng(1).standard_normal(mean.shape, dtype=np.float32)
    sampled = (mean + log_std.clamp(-20, 2).exp() * torch.from_numpy(noise)).tanh()
    observation = data["observation"].numpy()
    found = policy.sample(observation, np.random.default_rng(1))
    np.testing.assert_allclose(found, sampled, rtol=0, atol=5e-6)
    found = policy.deterministic(observation)
    np.testing.assert_allclose(found, mean.tanh(), rtol=0, atol=5e-6)
