"""RORLLoss against a plain restatement of its equations.

"RORL: Robust Offline Reinforcement Learning via Conservative Smoothing" (Yang et al.
2022, https://arxiv.org/abs/2206.02829), with the released code's reading of them.
"""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_osr.fast.traced_update import LossGradients
from torchrl_osr.lab.losses import EDACLoss, RORLLoss

GAMMA, ALPHA, TARGET_SCALE = 0.875, 0.5, 0.8
OPTIONS = {
    "num_samples": 4,
    "policy_smooth_reg": 0.7,
    "policy_smooth_eps": 0.3,
    "q_smooth_reg": 0.6,
    "q_smooth_eps": 0.2,
    "q_smooth_tau": 0.3,
    "q_ood_reg": 0.9,
    "q_ood_eps": 0.4,
    "q_ood_uncertainty_reg": 1.5,
    "q_ood_uncertainty_reg_min": 0.5,
    "q_ood_uncertainty_decay": 0.3,
}


def make_loss(networks, **options) -> RORLLoss:
    """A loss with every number off its default and targets of their own."""
    options = OPTIONS | {"alpha_init": ALPHA} | options
    loss = RORLLoss(networks.actor, networks.critics, **options).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda each: each.mul_(TARGET_SCALE))
    return loss


def sample(density: Normal) -> tuple[Tensor, Tensor]:
    """An action and its log-density, drawn as torch draws from a Normal."""
    z = density.rsample()
    action = z.tanh()
    return action, (density.log_prob(z) - (1 - action**2).log()).sum(-1)


def restated(networks, batch, log_alpha, options) -> dict[str, Tensor]:
    """The losses, row by row and draw by draw; no torchrl_osr."""
    critics, actor = (
        [each.module for each in networks.critics],
        networks.actor.module[0],
    )
    old = copy.deepcopy(critics)
    for network in old:
        for parameter in network.parameters():
            parameter.data.mul_(TARGET_SCALE)
    s, a = batch["observation"], batch["action"]
    ended = batch["next", "terminated"].squeeze(-1)
    s_next = torch.where(ended.unsqueeze(-1), s, batch["next", "observation"])
    alpha = log_alpha.detach().exp()

    def value(network, states, actions):
        return network(torch.cat([states, actions], -1)).squeeze(-1)

    def policy(states):
        return Normal(*actor(states)[1:])

    def draws(epsilon):
        box = torch.empty(options["num_samples"], s.shape[-1], dtype=s.dtype)
        return list(box.uniform_(-epsilon, epsilon))

    torch.manual_seed(5)
    pi = policy(s)
    action, log_prob = sample(pi)
    lowest = torch.stack([value(q, s, action) for q in critics]).min(0).values
    policy_loss = (alpha * log_prob - lowest).mean()
    if options["policy_smooth_reg"]:
        divergences = []
        for delta in draws(options["policy_smooth_eps"]):
            other = policy(s + delta)
            both = kl_divergence(pi, other) + kl_divergence(other, pi)
            divergences.append(both.sum(-1))
        largest = torch.stack([max(row) for row in zip(*divergences, strict=True)])
        policy_loss = policy_loss + options["policy_smooth_reg"] * largest.mean()
    with torch.no_grad():
        next_action, next_log_prob = sample(policy(s_next))
        after = torch.stack([value(q, s_next, next_action) for q in old]).min(0).values
        after = after - alpha * next_log_prob
        target = batch["next", "reward"].squeeze(-1) + GAMMA * (~ended) * after
    pred = [value(q, s, a) for q in critics]
    critic_loss = sum((each - target).square().mean() for each in pred)
    if options["q_smooth_reg"]:
        changes = []
        for delta in draws(options["q_smooth_eps"]):
            total = 0.0
            for q, clean in zip(critics, pred, strict=True):
                d = value(q, s + delta, a) - clean
                tau = options["q_smooth_tau"]
                total = total + torch.where(d > 0, 1 - tau, tau) * d.square()
            changes.append(total / len(critics))
        largest = torch.stack([max(row) for row in zip(*changes, strict=True)])
        critic_loss = critic_loss + options["q_smooth_reg"] * largest.mean()
    if options["q_ood_reg"]:
        states = torch.stack([s + delta for delta in draws(options["q_ood_eps"])])
        with torch.no_grad():
            actions, _ = sample(policy(states))
        values = torch.stack([value(q, states, actions) for q in critics])
        deviation = values.std(0, correction=1)
        target = (values - options["weight"] * deviation).detach()
        penalty = nn.functional.mse_loss(values, target)
        critic_loss = critic_loss + options["q_ood_reg"] * penalty
    target_entropy = -a.shape[-1]
    return {
        "loss_actor": policy_loss,
        "loss_alpha": -(log_alpha * (log_prob.detach() + target_entropy)).mean(),
        "loss_qvalue": critic_loss,
    }


WITHOUT = {
    "all": {},
    "policy alone": {"q_smooth_reg": 0.0, "q_ood_reg": 0.0},
    "values alone": {"policy_smooth_reg": 0.0, "q_ood_reg": 0.0},
    "uncertainty alone": {"policy_smooth_reg": 0.0, "q_smooth_reg": 0.0},
}


# Critics with ReLUs are plain MLPs, which have a path of their own on a CPU.
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
@pytest.mark.parametrize("without", WITHOUT)
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check_restated, activation, without
) -> None:
    networks = make_networks(num_critics=3, critic_activation=activation)
    batch, reference = make_batch(10), copy.deepcopy(networks)
    options = OPTIONS | WITHOUT[without]
    loss = make_loss(networks, **options)
    loss.decay_uncertainty()
    log_alpha = torch.tensor(math.log(ALPHA)).double().requires_grad_()
    torch.manual_seed(5)
    out = loss(batch)
    expected = restated(reference, batch, log_alpha, options | {"weight": 1.2})
    losses = {key: out[key] for key in expected}
    networks = reference.actor, reference.critics, log_alpha
    check_restated("RORL", loss, losses, expected, *networks, tolerance=1e-10)


def test_the_weight_of_the_uncertainty_falls_to_its_floor(make_networks) -> None:
    loss, seen = make_loss(make_networks(), q_ood_uncertainty_reg=1.0), []
    for _ in range(4):
        seen.append(loss.uncertainty_weight.item())
        loss.decay_uncertainty()
    assert seen == pytest.approx([1.0, 0.7, 0.5, 0.5])
    other = make_loss(make_networks(), q_ood_uncertainty_reg=1.0)
    other.load_state_dict(loss.state_dict())
    assert other.num_updates == 4
    # A million small steps, of which each is lost in float32.
    single = RORLLoss(
        make_networks().actor, make_networks().critics,
        q_ood_uncertainty_reg=4.0, q_ood_uncertainty_decay=1e-7,
    )  # fmt: skip
    single.num_updates += 10**6 - 1
    single.decay_uncertainty()
    assert single.uncertainty_weight.item() == pytest.approx(3.9)


def test_a_recording_sees_the_weight_fall(make_networks, make_batch) -> None:
    loss, batch = make_loss(make_networks()), make_batch(10)
    recorded = LossGradients(loss, warm_up=0)
    plain = LossGradients(loss, trace=False)
    found = []
    for gradients in (plain, recorded, recorded):
        torch.manual_seed(5)
        found.append(gradients(batch.clone())["loss_qvalue"])
    assert torch.equal(found[0], found[2])
    loss.decay_uncertainty()
    for gradients in (plain, recorded):
        torch.manual_seed(5)
        found.append(gradients(batch.clone())["loss_qvalue"])
    assert torch.equal(found[3], found[4])
    assert found[4] < found[2]


def test_without_its_terms_it_is_sac_n_as_edac_has_it(
    make_networks, make_batch
) -> None:
    networks, batch = make_networks(num_critics=3), make_batch(10)
    nothing = {"policy_smooth_reg": 0.0, "q_smooth_reg": 0.0, "q_ood_reg": 0.0}
    loss = make_loss(networks, **nothing)
    sac = EDACLoss(
        networks.actor, networks.critics, diversity_weight=0.0, alpha_init=ALPHA
    ).double()
    sac.make_value_estimator(gamma=GAMMA)
    SoftUpdate(sac, tau=0.1)
    sac.target_qvalue_network_params.apply_(lambda each: each.mul_(TARGET_SCALE))
    found = []
    for each in (loss, sac):
        torch.manual_seed(5)
        found.append(each(batch))
    for key in ("loss_actor", "loss_alpha", "loss_qvalue", "entropy"):
        torch.testing.assert_close(found[0][key], found[1][key], rtol=1e-12, atol=0)
    assert loss.out_keys == [*found[0].keys()]


@pytest.mark.parametrize(
    ("critics", "options", "message"),
    [
        (1, {}, "num_qvalue_nets of at least 2"),
        (2, {"q_ood_reg": -1.0}, "q_ood_reg must be at least 0, got -1"),
        (2, {"num_samples": 0}, "num_samples must be at least 1, got 0"),
        (2, {"q_smooth_tau": 2.0}, r"q_smooth_tau must be in \[0, 1\], got 2"),
        (2, {"q_ood_uncertainty_reg": 0.1}, "lower the latter"),
    ],
)
def test_wrong_options_are_refused(make_networks, critics, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(make_networks(num_critics=critics), **options)
