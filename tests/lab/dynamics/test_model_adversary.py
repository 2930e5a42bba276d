"""RAMBO's model against its objective written out, and what becomes of the model.

"RAMBO-RL: Robust Adversarial Model-Based Offline Reinforcement Learning" (Rigter et al.
2022, https://arxiv.org/abs/2204.12581).
"""

from __future__ import annotations

import math

import torch
from objectives.losses import Networks, make_batch
from torch import Tensor
from torchrl.data import LazyTensorStorage
from torchrl.objectives import SoftUpdate
from uneven_dynamics import compare_models, plain_gaussian, uneven_dynamics

from torchrl_osr import CQLLoss
from torchrl_osr.lab.dynamics import (
    DynamicsEnsemble,
    DynamicsOptions,
    ModelAdversary,
    ModelData,
)

GAMMA = 0.875


def falls(state: Tensor) -> Tensor:
    return state[..., 0] > 0.5


def make_adversary(networks: Networks) -> ModelAdversary:
    loss = CQLLoss(networks.actor, networks.critics, min_q_weight=0.0).double()
    SoftUpdate(loss, tau=0.1)
    rows, storage = make_batch("osr", 50), LazyTensorStorage(50)
    storage.set(range(50), rows)
    data = ModelData(
        storage, rows, torch.zeros(3), torch.ones(3), reward_scale=1.0, gamma=GAMMA,
        env_id="Hopper-v5", seed=0,
    )  # fmt: skip
    options = DynamicsOptions(
        adversarial_steps=5, adversarial_weight=0.5, adversarial_lr=1e-2,
        rollout_steps=2, batch_size=8,
    )  # fmt: skip
    adversary = ModelAdversary(options, data, uneven_dynamics(), loss, networks.actor)
    adversary.terminated = falls
    return adversary


def restated(networks: Networks, model: DynamicsEnsemble, states: Tensor) -> Tensor:
    """The objective, row by row, with the same draws."""
    rows = len(states)
    zeros = torch.zeros(rows, 2, dtype=torch.float64)
    action_noise = torch.normal(zeros, torch.ones_like(zeros))
    drawn = torch.randint(2, (rows,))
    noise = torch.randn(rows, 4, dtype=torch.float64)
    critics = [each.module for each in networks.critics]
    policy, advantage, log_density = networks.actor[0].module, [], []

    def value(state: Tensor, action: Tensor) -> Tensor:
        pair = torch.cat([state, action])
        return min(critic(pair)[0].detach() for critic in critics)

    for row, state in enumerate(states):
        loc, scale = policy(state)
        action = torch.tanh(loc + scale * action_noise[row]).detach()
        gaussians = []
        for number in (0, 2):
            mean, variance = plain_gaussian(model, number, state, action)
            mean = mean * model.target_scale + model.target_loc
            gaussians.append((mean, variance.sqrt() * model.target_scale))
        mean, scale = gaussians[drawn[row]]
        sample = (mean + scale * noise[row]).detach()
        following, reward = state + sample[:3], sample[3]
        after = value(following, policy(following)[0].tanh()) * ~falls(following)
        advantage.append(reward + GAMMA * after - value(state, action))
        densities = [
            torch.exp(-(((sample - mean) / scale) ** 2) / 2)
            / (scale * math.sqrt(2 * math.pi))
            for mean, scale in gaussians
        ]
        log_density.append(torch.log(sum(each.prod() for each in densities) / 2))
    advantage = torch.stack(advantage)
    spread = ((advantage - advantage.mean()) ** 2).sum() / (rows - 1)
    standardized = (advantage - advantage.mean()) / (spread.sqrt() + 1e-6)
    return standardized * torch.stack(log_density)


def test_objective_and_gradients_equal_the_restatement(check) -> None:
    networks, plain, model = Networks(number=3), Networks(number=3), uneven_dynamics()
    adversary = make_adversary(networks)
    states = make_batch("osr", 12)["observation"]
    torch.manual_seed(6)
    got, _ = adversary.objective(states)
    torch.manual_seed(6)
    wanted = restated(plain, model, states)
    got.mean().backward(retain_graph=True)
    assert not any(each.grad is not None for each in adversary.loss.parameters())
    compare_models(check, "RAMBO", (got, adversary.model), (wanted, model))


def test_equal_numbers_draw_equally() -> None:
    pair = [make_adversary(Networks()) for _ in range(2)]
    for number, adversary in enumerate(pair):
        torch.manual_seed(number)
        generator = torch.get_rng_state()
        adversary(1)
        assert torch.equal(torch.get_rng_state(), generator)
    assert all(map(torch.equal, *(each.model.parameters() for each in pair)))
