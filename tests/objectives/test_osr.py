"""OSRLoss against a plain restatement of its equations: losses, gradients, CQL(H)."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, StatePerturbation

GAMMA, NUM_RANDOM, TEMPERATURE, ALPHA = 0.875, 4, 1.7, 0.3
MIN_Q_WEIGHT, TARGET_ENTROPY, TARGET_SCALE = 2.5, -1.5, 0.8
LOSSES = ["loss_actor", "loss_alpha", "loss_qvalue", "loss_cql", "loss_recovery"]


def make_osr(networks, *, weight: float = 0.75, **kwargs) -> OSRLoss:
    """A loss with every option off its default and target critics of their own."""
    settings = {
        "min_q_weight": MIN_Q_WEIGHT,
        "num_random": NUM_RANDOM,
        "temperature": TEMPERATURE,
        "alpha_init": ALPHA,
        "target_entropy": TARGET_ENTROPY,
    } | kwargs
    loss = OSRLoss(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        recovery_weight=weight,
        **settings,
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    return loss


def network_losses(loss, batch) -> dict[str, Tensor]:
    return {key: value for key, value in loss(batch).items() if key in LOSSES}


class Restatement:
    """The equations once more: critics in a loop, densities by hand, no torchrl_osr."""

    def __init__(
        self, networks, *, low: Tensor, high: Tensor, weight: float, variant: str
    ) -> None:
        networks = copy.deepcopy(networks)
        self.policy_net, self.idm_net = networks.actor[0], networks.inverse_dynamics[0]
        self.critics = [critic.module for critic in networks.critics]
        self.targets = copy.deepcopy(self.critics)
        for target in self.targets:
            for parameter in target.parameters():
                parameter.data.mul_(TARGET_SCALE)
        self.log_alpha = torch.tensor(math.log(ALPHA)).double().requires_grad_()
        self.center, self.half = (high + low) / 2, (high - low) / 2
        self.weight, self.variant = weight, variant

    def policy(self, state: Tensor) -> Normal:
        _, loc, scale = self.policy_net(state)
        return Normal(loc, scale)

    def act(self, gaussian: Normal, noise: Tensor) -> tuple[Tensor, Tensor]:
        """tanh-Gaussian action and log-density, by the change of variables."""
        x = gaussian.loc + gaussian.scale * noise
        squashed = torch.tanh(x)
        log_prob = gaussian.log_prob(x) - torch.log(self.half * (1 - squashed**2))
        return self.center + self.half * squashed, log_prob.sum(-1)

    def log_prob(self, gaussian: Normal, action: Tensor) -> Tensor:
        """Log-density of a given action, by the change of variables."""
        squashed = (action - self.center) / self.half
        log_prob = gaussian.log_prob(torch.atanh(squashed))
        return (log_prob - torch.log(self.half * (1 - squashed**2))).sum(-1)

    def losses(self, batch, seed: int) -> dict[str, Tensor]:
        s, a = batch["observation"], batch["action"]
        reward = batch["next", "reward"].squeeze(-1)
        done = batch["next", "done"]
        terminated = batch["next", "terminated"]
        # Rows without a next state never reach a network; any finite stand-in will do.
        s_next = torch.where(terminated, s, batch["next", "observation"])
        s_tot = torch.stack([s, batch["perturbed", "observation"]])
        # Where values are sought, and where the policy recovers: the paper's D_tot, or
        # what the authors' released code has, or the data alone.
        official, cloning = "official" in self.variant, "cloning" in self.variant
        if self.variant in CLEAN:
            s_tot = s_tot[:1]
        s_actor = s_tot[:1] if official else s_tot
        s_recover = s_tot[1:] if official else s_tot
        # The draws, in the order in which the loss makes them.
        torch.manual_seed(seed)
        like = {"dtype": torch.float64}
        noise_actor = torch.randn(*s_actor.shape[:-1], a.shape[-1], **like)
        uniform = 2 * torch.rand(NUM_RANDOM, *a.shape, **like) - 1
        noise_proposals = torch.randn(NUM_RANDOM, 2, *a.shape, **like)
        noise_target = torch.randn(*a.shape, **like)

        action, log_prob = self.act(self.policy(s_actor), noise_actor)
        values = torch.stack([q(s_actor, action).squeeze(-1) for q in self.critics])
        alpha = self.log_alpha.detach().exp()
        losses = {
            "loss_actor": (alpha * log_prob - values.amin(0)).mean(),
            "loss_alpha": (
                -self.log_alpha * (log_prob.detach() + TARGET_ENTROPY)
            ).mean(),
        }
        with torch.no_grad():
            next_action, _ = self.act(self.policy(s_next), noise_target)
            bootstrap = torch.stack(
                [q(s_next, next_action).squeeze(-1) for q in self.targets]
            ).amin(0)
            target = reward + GAMMA * (1 - terminated.squeeze(-1).double()) * bootstrap
            box = -torch.log(2 * self.half).sum()
            proposals = [(self.center + self.half * u, box) for u in uniform]
            for noise in noise_proposals:
                proposals.append(self.act(self.policy(s), noise[0]))
                proposals.append(self.act(self.policy(s_next), noise[1]))
        td, gap = 0.0, 0.0
        for critic in self.critics:
            pred = critic(s, a).squeeze(-1)
            logits = torch.stack(
                [
                    (critic(s, x).squeeze(-1) - density) / TEMPERATURE
                    for x, density in proposals
                ]
            )
            td = td + (pred - target) ** 2
            gap = gap + TEMPERATURE * logits.exp().sum(0).log() - pred
        losses |= {"loss_qvalue": td.mean(), "loss_cql": MIN_Q_WEIGHT * gap.mean()}
        if self.weight:
            with torch.no_grad():
                s_next = s_next.expand_as(s_recover)
                _, loc, scale = self.idm_net(s_recover, s_next)
            model, policy = Normal(loc, scale), self.policy(s_recover)
            if cloning:
                kl = -self.log_prob(policy, a.expand_as(loc))
            elif official:
                kl = kl_divergence(policy, model).mean(-1)
            else:
                kl = kl_divergence(model, policy).sum(-1)
            valid = ~done.squeeze(-1)
            losses["loss_recovery"] = self.weight * kl.mean(0)[valid].mean()
        return losses


VARIANTS = {
    "OSR": {},
    "CQL(H)": {"weight": 0.0},
    "OSR, official variant": {
        "recovery_direction": "reverse",
        "action_reduction": "mean",
        "recovery_states": "perturbed",
        "actor_states": "clean",
    },
    "OSR, clean states": {"recovery_states": "clean"},
    "CQL(H) and cloning": {
        "recovery_target": "data",
        "recovery_states": "clean",
    },
    "CQL(H) and noisy cloning": {"recovery_target": "data"},
}

CLEAN = ["CQL(H)", "OSR, clean states", "CQL(H) and cloning"]  # no perturbed state


@pytest.mark.parametrize("variant", VARIANTS)
# Bounds are float64 tensors: TorchRL would keep numbers in float32, to 1e-8 only.
@pytest.mark.parametrize(
    ("low", "high"), [([-1.0, -1.0], [1.0, 1.0]), ([-1.0, -0.5], [2.0, 1.5])]
)
# Critics with ReLUs are plain MLPs, which have a path of their own.
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check, variant, low, high, activation
) -> None:
    options = {"weight": 0.75} | VARIANTS[variant]
    weight = options["weight"]
    bounds = {"low": torch.tensor(low).double(), "high": torch.tensor(high).double()}
    networks = make_networks(**bounds, critic_activation=activation)
    batch = make_batch(10)
    restatement = Restatement(networks, **bounds, weight=weight, variant=variant)
    loss = make_osr(networks, **options)
    torch.manual_seed(5)
    losses = network_losses(loss, batch)
    expected = restatement.losses(batch, seed=5)
    assert set(losses) == set(expected) == set(LOSSES[: 5 if weight else 4])
    values = [losses[key] for key in expected]
    check(variant, values, expected.values(), tolerance=1e-8)

    # The sum of ours is correct training; the plain one needs each group by itself.
    actor = list(restatement.policy_net.parameters())
    critics = [
        parameter for critic in restatement.critics for parameter in critic.parameters()
    ]
    policy_part = expected["loss_actor"] + expected.get("loss_recovery", 0)
    expected_actor = torch.autograd.grad(policy_part, actor)
    critic_part = expected["loss_qvalue"] + expected["loss_cql"]
    expected_critic = torch.autograd.grad(critic_part, critics)
    (expected_alpha,) = torch.autograd.grad(
        expected["loss_alpha"], restatement.log_alpha
    )
    sum(losses.values()).backward()
    ours = [p.grad for p in loss.actor_network_params.values(True, True)]
    half = len(critics) // 2
    first, second = expected_critic[:half], expected_critic[half:]
    stacked = [torch.stack(pair) for pair in zip(first, second, strict=True)]
    ours += [p.grad for p in loss.qvalue_network_params.values(True, True)]
    ours.append(loss.log_alpha.grad)
    wanted = [*expected_actor, *stacked, expected_alpha]
    check(variant, ours, wanted, tolerance=1e-7)


@pytest.mark.parametrize("recovery_weight", [0.75, 0.0])
def test_behavior_cloning_puts_the_data_in_the_place_of_the_values(
    make_networks, make_batch, recovery_weight
) -> None:
    networks, batch = make_networks(), make_batch(10)
    loss = make_osr(networks, weight=recovery_weight, behavior_cloning=True)
    torch.manual_seed(5)
    out = loss(batch)
    # -log alpha (mean log pi + target) tells the entropy that was drawn.
    entropy = out["entropy"]
    cloned = networks.actor.get_dist(batch).log_prob(batch["action"]).mean()
    expected = -math.exp(loss.log_alpha.item()) * entropy - cloned
    torch.testing.assert_close(out["loss_actor"], expected)
    out["loss_actor"].backward()
    assert all(p.grad is None for p in loss.qvalue_network_params.values(True, True))
    # The other terms are what they are without it, and so is this one afterwards.
    reference = make_osr(make_networks(), weight=recovery_weight)
    loss.behavior_cloning = False
    for each in (loss, reference):
        torch.manual_seed(5)
        each.record = network_losses(each, make_batch(10))
    assert loss.record == reference.record
    for key in set(reference.record) - {"loss_actor"}:
        assert torch.equal(out[key], reference.record[key])


def test_metrics_say_what_they_are_called(make_networks, make_batch) -> None:
    loss, batch = make_osr(make_networks()), make_batch(10)
    out = loss(batch)
    assert out["alpha"].item() == pytest.approx(ALPHA)
    recovery = loss.recovery_weight * out["recovery_kl"]
    assert out["loss_recovery"].item() == pytest.approx(recovery.item())
    # -log alpha (mean log pi + target): the entropy is what the temperature sees.
    entropy = TARGET_ENTROPY + out["loss_alpha"] / math.log(ALPHA)
    assert out["entropy"].item() == pytest.approx(entropy.item())
    pred = sum(
        critic(batch.clone())["state_action_value"].mean()
        for critic in make_networks().critics
    )
    assert out["pred_value"].item() == pytest.approx(pred.item() / 2)


@pytest.mark.parametrize("function", ["l1", "l2", "smooth_l1"])
def test_priority_is_the_largest_td_error_of_the_critics(
    make_networks, make_batch, function
) -> None:
    loss = make_osr(make_networks(num_critics=1), loss_function=function)
    batch = make_batch(10)
    out = loss(batch)
    error = batch["td_error"]
    assert error.shape == (10,)
    assert not error.requires_grad
    # With one critic the TD loss is a function of the priority alone.
    distance = {
        "l1": error,
        "l2": error**2,
        "smooth_l1": torch.where(error < 1, error**2 / 2, error - 0.5),
    }[function]
    torch.testing.assert_close(out["loss_qvalue"].detach(), distance.mean())


def test_priority_belongs_to_the_worst_critic(make_networks, make_batch) -> None:
    networks, batch = make_networks(), make_batch(10)
    loss = make_osr(networks)
    loss.make_value_estimator(gamma=0.0)
    loss(batch)
    errors = [
        critic(batch.clone())["state_action_value"] - batch["next", "reward"]
        for critic in make_networks().critics
    ]
    wanted = torch.cat(errors, -1).abs().amax(-1)
    torch.testing.assert_close(batch["td_error"], wanted.detach())


def train(loss, batch, steps: int) -> list[Tensor]:
    """Losses, gradients and parameters of a few optimizer steps."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    updater = SoftUpdate(loss, tau=0.1)
    record = []
    torch.manual_seed(11)
    for _ in range(steps):
        losses = network_losses(loss, batch)
        optimizer.zero_grad()
        sum(losses.values()).backward()
        record += [value.detach() for value in losses.values()]
        record += [parameter.grad.clone() for parameter in loss.parameters()]
        optimizer.step()
        updater.step()
    return record + [parameter.detach().clone() for parameter in loss.parameters()]


@pytest.mark.parametrize("with_model", [True, False])
@pytest.mark.parametrize("perturb", [True, False])
def test_weight_zero_is_cql_to_the_bit_whatever_else_is_given(
    make_networks, make_batch, with_model, perturb
) -> None:
    reference = make_osr(make_networks(), weight=0.0)
    expected = train(reference, make_batch(10, twin=False), 10)
    networks, batch = make_networks(), make_batch(10, twin=False)
    if not with_model:
        networks.inverse_dynamics = None
    loss = make_osr(networks, weight=0.0)
    if perturb:
        batch = StatePerturbation(std=0.1)(batch)
    for got, wanted in zip(train(loss, batch, 10), expected, strict=True):
        assert torch.equal(got, wanted)


@pytest.mark.parametrize(("weight", "calls"), [(0.75, 1), (0.0, 0)])
def test_weight_zero_never_calls_the_inverse_dynamics_model(
    make_networks, make_batch, weight, calls
) -> None:
    networks, counted = make_networks(), []
    networks.inverse_dynamics[0][0].register_forward_pre_hook(
        lambda *_: counted.append(1)
    )
    make_osr(networks, weight=weight)(make_batch(10))
    assert len(counted) == calls
