"""EDACLoss against a plain restatement of its equations, critic by critic.

"Uncertainty-Based Offline Reinforcement Learning with Diversified Q-Ensemble" (An et
al. 2021, https://arxiv.org/abs/2110.01548).
"""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import AffineTransform, TanhTransform
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.losses import EDACLoss

GAMMA, ALPHA, TARGET_ENTROPY, TARGET_SCALE = 0.875, 0.3, -1.5, 0.8


def make_loss(loss_class, networks, **options):
    """A loss with target critics of their own."""
    loss = loss_class(
        networks.actor,
        networks.critics,
        alpha_init=ALPHA,
        target_entropy=TARGET_ENTROPY,
        **options,
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    # The constructor takes the logarithm in float32.
    loss.log_alpha.data.fill_(math.log(ALPHA))
    return loss


def losses_of(loss, batch) -> dict[str, Tensor]:
    torch.manual_seed(5)
    return {key: v for key, v in loss(batch).items() if key.startswith("loss_")}


def diversity(critics, state: Tensor, action: Tensor) -> Tensor:
    """Similarity of the critics' action gradients, all pairs, ``[B]``."""
    leaf, units = action.clone().requires_grad_(), []
    for q in critics:
        value = q(state, leaf).sum()
        (gradient,) = torch.autograd.grad(value, leaf, create_graph=True)
        units.append(gradient / gradient.norm(dim=-1, keepdim=True))
    number = len(units)
    pairs = [(i, j) for i in range(number) for j in range(number) if i != j]
    return sum((units[i] * units[j]).sum(-1) for i, j in pairs) / (number - 1)


def restated(networks, batch, bounds, weight: float, log_alpha: Tensor):
    """The losses, one critic at a time; no torchrl_osr."""
    low, high = bounds["low"], bounds["high"]
    critics = [critic.module for critic in networks.critics]
    targets = copy.deepcopy(critics)
    for target in targets:
        for parameter in target.parameters():
            parameter.data.mul_(TARGET_SCALE)

    def act(state: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        _, loc, scale = networks.actor[0](state)
        half = (high - low) / 2
        squash = [TanhTransform(cache_size=1), AffineTransform(low + half, half)]
        base = Independent(Normal(loc, scale), 1)
        action = base.mean + base.stddev * noise
        for transform in squash:
            action = transform(action)
        return action, TransformedDistribution(base, squash).log_prob(action)

    def lowest(ensemble, state: Tensor, action: Tensor) -> Tensor:
        return torch.stack([q(state, action).squeeze(-1) for q in ensemble]).amin(0)

    s, a = batch["observation"], batch["action"]
    ended = batch["next", "terminated"]
    s_next = torch.where(ended, s, batch["next", "observation"])
    # The draws, in the order in which the loss makes them.
    torch.manual_seed(5)
    noise, next_noise = (torch.randn(a.shape, dtype=a.dtype) for _ in range(2))
    action, log_prob = act(s, noise)
    with torch.no_grad():
        next_action, next_log_prob = act(s_next, next_noise)
        value = lowest(targets, s_next, next_action) - ALPHA * next_log_prob
        alive = 1 - ended.squeeze(-1).double()
        target = batch["next", "reward"].squeeze(-1) + GAMMA * alive * value
    td = sum((q(s, a).squeeze(-1) - target).square().mean() for q in critics)
    entropy_gap = log_prob.detach() + TARGET_ENTROPY
    return {
        "loss_actor": (ALPHA * log_prob - lowest(critics, s, action)).mean(),
        "loss_alpha": (-log_alpha * entropy_gap).mean(),
        "loss_qvalue": td + weight * diversity(critics, s, a).mean(),
    }


UNIT = {"low": -torch.ones(2).double(), "high": torch.ones(2).double()}
BOX = {
    "low": torch.tensor([-1.0, -0.5]).double(),
    "high": torch.tensor([2.0, 1.5]).double(),
}
# Critics with ReLUs are plain MLPs, which have a path of their own on a CPU.
RELU = {"critic_activation": nn.ReLU}
WAYS = {
    "vmap": (UNIT, {"num_critics": 2}, {}),
    "loop": (BOX, {"num_critics": 4}, {"deactivate_vmap": True}),
    "plain": (BOX, {"num_critics": 10} | RELU, {}),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("weight", [0.75, 0.0])
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check_restated, way, weight
) -> None:
    bounds, critics, options = WAYS[way]
    networks, batch = make_networks(**bounds, **critics), make_batch(10)
    reference = copy.deepcopy(networks)
    log_alpha = torch.tensor(math.log(ALPHA), dtype=torch.float64).requires_grad_()
    loss = make_loss(EDACLoss, networks, diversity_weight=weight, **options)
    losses = losses_of(loss, batch)
    expected = restated(reference, batch, bounds, weight, log_alpha)
    label = "EDAC" if weight else "SAC-N"
    check_restated(
        label, loss, losses, expected, reference.actor, reference.critics, log_alpha
    )


def test_metric_is_what_the_diversity_adds(make_networks, make_batch) -> None:
    networks, batch = make_networks(num_critics=3), make_batch(10)
    loss = make_loss(EDACLoss, networks, diversity_weight=0.75)
    torch.manual_seed(5)
    out = loss(batch)
    critics = [critic.module for critic in networks.critics]
    similarity = diversity(critics, batch["observation"], batch["action"]).mean()
    torch.testing.assert_close(out["diversity"], similarity.detach())
    assert not out["diversity"].requires_grad
    loss.diversity_weight = 0.0
    added = out["loss_qvalue"] - losses_of(loss, batch)["loss_qvalue"]
    torch.testing.assert_close(added, 0.75 * similarity)
