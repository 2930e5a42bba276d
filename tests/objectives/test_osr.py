"""OSRLoss against a plain restatement of its equations: losses, gradients, CQL(H).

"Conservative Q-Learning" (Kumar et al. 2020, https://arxiv.org/abs/2006.04779) and its
common implementations for CQL's options, "Uncertainty-Based Offline Reinforcement
Learning with Diversified Q-Ensemble" (An et al. 2021,
https://arxiv.org/abs/2110.01548) for SAC-N.
"""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRLoss, StatePerturbation

GAMMA, K, ALPHA, LOG_PRIME = 0.875, 3, 0.3, 0.4
TARGET_ENTROPY, TARGET_SCALE = -1.5, 0.8
# Every option, most numbers off their defaults.
OPTIONS = {
    "recovery_weight": 0.75,
    "recovery_direction": "forward",
    "recovery_target": "inverse_dynamics",
    "recovery_states": "both",
    "action_reduction": "sum",
    "actor_states": "both",
    "min_q_weight": 2.5,
    "temperature": 1.7,
    "clip_diff_min": -math.inf,
    "max_q_backup": False,
    "deterministic_backup": True,
    "with_lagrange": False,
    "lagrange_thresh": 2.0,
}


def make_osr(networks, **options) -> OSRLoss:
    """A loss with target critics of their own."""
    numbers = {
        "num_random": K,
        "alpha_init": ALPHA,
        "target_entropy": TARGET_ENTROPY,
    }
    loss = OSRLoss(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        **(OPTIONS | numbers | options),
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    # The constructor takes the logarithm in float32.
    loss.log_alpha.data.fill_(math.log(ALPHA))
    if loss.with_lagrange:
        loss.log_alpha_prime.data.fill_(LOG_PRIME)
    return loss


def losses_of(loss, batch, seed: int = 5) -> dict[str, Tensor]:
    torch.manual_seed(seed)
    return {key: v for key, v in loss(batch).items() if key.startswith("loss_")}


class Restatement:
    """The equations once more: critics and actions in loops, no torchrl_osr."""

    def __init__(self, networks, *, low: Tensor, high: Tensor, **options) -> None:
        networks = copy.deepcopy(networks)
        self.policy_net, self.idm_net = networks.actor[0], networks.inverse_dynamics[0]
        self.critics = [critic.module for critic in networks.critics]
        self.targets = copy.deepcopy(self.critics)
        for target in self.targets:
            for parameter in target.parameters():
                parameter.data.mul_(TARGET_SCALE)
        self.log_alpha, self.log_prime = (
            torch.tensor(number, dtype=torch.float64).requires_grad_()
            for number in (math.log(ALPHA), LOG_PRIME)
        )
        self.center, self.half = (high + low) / 2, (high - low) / 2
        self.options = OPTIONS | options

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

    def losses(self, batch, seed: int = 5) -> dict[str, Tensor]:
        torch.manual_seed(seed)
        ended = batch["next", "terminated"]
        # Rows without a next state never reach a network; any finite stand-in will do.
        batch = batch.clone()
        batch["next", "observation"] = torch.where(
            ended, batch["observation"], batch["next", "observation"]
        )
        losses = self.policy_losses(batch)
        # The loss draws the conservative term's actions before the target's.
        cql = self.conservative_losses(batch) if self.options["min_q_weight"] else {}
        return losses | {"loss_qvalue": self.td_error(batch)} | cql

    def states(self, batch, which: str) -> Tensor:
        both = [batch["observation"], batch["perturbed", "observation"]]
        return torch.stack({"clean": both[:1], "perturbed": both[1:]}.get(which, both))

    def policy_losses(self, batch) -> dict[str, Tensor]:
        s = self.states(batch, self.options["actor_states"])
        noise = torch.randn(*s.shape[:-1], len(self.half), dtype=s.dtype)
        action, log_prob = self.act(self.policy(s), noise)
        values = torch.stack([q(s, action).squeeze(-1) for q in self.critics])
        alpha = self.log_alpha.detach().exp()
        actor = (alpha * log_prob - values.amin(0)).mean()
        if self.options["recovery_weight"]:
            actor = actor + self.options["recovery_weight"] * self.recovery(batch)
        entropy_gap = log_prob.detach() + TARGET_ENTROPY
        return {
            "loss_actor": actor,
            "loss_alpha": (-self.log_alpha * entropy_gap).mean(),
        }

    def recovery(self, batch) -> Tensor:
        s = self.states(batch, self.options["recovery_states"])
        policy, a = self.policy(s), batch["action"]
        if self.options["recovery_target"] == "data":
            each = -self.log_prob(policy, a.expand_as(policy.loc))
        else:
            with torch.no_grad():
                _, *model = self.idm_net(s, batch["next", "observation"].expand_as(s))
            pair = [Normal(*model), policy]
            if self.options["recovery_direction"] == "reverse":
                pair.reverse()
            each = kl_divergence(*pair)
            mean = self.options["action_reduction"] == "mean"
            each = each.sum(-1) / (a.shape[-1] if mean else 1)
        return each.mean(0)[~batch["next", "done"].squeeze(-1)].mean()

    @torch.no_grad()
    def td_target(self, batch) -> Tensor:
        s_next, a = batch["next", "observation"], batch["action"]
        number = K if self.options["max_q_backup"] else 1
        values = []
        for noise in torch.randn(number, *a.shape, dtype=a.dtype):
            action, log_prob = self.act(self.policy(s_next), noise)
            value = torch.stack([q(s_next, action) for q in self.targets]).amin(0)
            if not self.options["deterministic_backup"]:
                value = value - ALPHA * log_prob.unsqueeze(-1)
            values.append(value)
        alive = 1 - batch["next", "terminated"].double()
        best = torch.stack(values).amax(0)
        return batch["next", "reward"] + GAMMA * alive * best

    def td_error(self, batch) -> Tensor:
        s, a = batch["observation"], batch["action"]
        self.target = self.td_target(batch)
        return sum((q(s, a) - self.target).square().mean() for q in self.critics)

    @torch.no_grad()
    def proposals(self, batch) -> list[tuple[Tensor, Tensor]]:
        s, a = batch["observation"], batch["action"]
        s_next, box = batch["next", "observation"], -torch.log(2 * self.half).sum()
        uniform = 2 * torch.rand(K, *a.shape, dtype=a.dtype) - 1
        found = [(self.center + self.half * each, box) for each in uniform]
        for noise in torch.randn(K, 2, *a.shape, dtype=a.dtype):
            found.append(self.act(self.policy(s), noise[0]))
            found.append(self.act(self.policy(s_next), noise[1]))
        return found

    def conservative_losses(self, batch) -> dict[str, Tensor]:
        s, a, o = batch["observation"], batch["action"], self.options
        proposals, tau, gaps = self.proposals(batch), o["temperature"], []
        for q in self.critics:
            # Importance weights 1 / p, whatever the temperature.
            terms = [
                (q(s, x).squeeze(-1) / tau).exp() / density.exp()
                for x, density in proposals
            ]
            gap = tau * sum(terms).log() - q(s, a).squeeze(-1)
            gaps.append(gap.clamp(min=o["clip_diff_min"]).mean())
        weight = o["min_q_weight"]
        if not o["with_lagrange"]:
            return {"loss_cql": weight * sum(gaps)}
        # CORL: half the sum over two critics, both sides of one product.
        gaps = [gap - o["lagrange_thresh"] for gap in gaps]
        slack = sum(gap.detach() for gap in gaps) / len(gaps)
        return {
            "loss_cql": weight * math.exp(LOG_PRIME) * sum(gaps),
            "loss_alpha_prime": -weight * self.log_prime.exp() * slack,
        }


CQL = {"recovery_weight": 0.0, "actor_states": "clean"}
LAGRANGE = {"with_lagrange": True}
SAC_N = {"min_q_weight": 0.0, "deterministic_backup": False}
# Up to the colon: the label of the checks.
VARIANTS = {
    "OSR": {},
    "OSR: temperature 1": {"temperature": 1.0},
    "OSR: recovery at clean states": {"recovery_states": "clean"},
    "OSR: values at perturbed states": {"actor_states": "perturbed"},
    "OSR, clean states": {"recovery_states": "clean", "actor_states": "clean"},
    "OSR, official variant": {
        "recovery_direction": "reverse",
        "action_reduction": "mean",
        "recovery_states": "perturbed",
        "actor_states": "clean",
    },
    "OSR-10": SAC_N,
    "CQL(H)": CQL,
    "CQL(H): on D_tot": {"recovery_weight": 0.0, "actor_states": "both"},
    "CQL(H) and cloning": {
        "recovery_target": "data",
        "recovery_states": "clean",
        "actor_states": "clean",
    },
    "CQL(H) and noisy cloning": {"recovery_target": "data"},
    "CQL(H) with its options: temperature": CQL | {"temperature": 0.6},
    "CQL(H) with its options: clipped": CQL | {"clip_diff_min": 5.9},
    "CQL(H) with its options: max backup": CQL | {"max_q_backup": True},
    "CQL(H) with its options: entropy": CQL | {"deterministic_backup": False},
    "CQL(H) with its options: lagrange": CQL | LAGRANGE,
    "CQL(H) with its options: all": CQL
    | LAGRANGE
    | {"clip_diff_min": 5.9, "lagrange_thresh": -1.0, "max_q_backup": True},
    "SAC-N": CQL | SAC_N,
}

# Bounds are float64 tensors: TorchRL would keep numbers in float32, to 1e-8 only.
UNIT = {"low": -torch.ones(2).double(), "high": torch.ones(2).double()}
BOX = {
    "low": torch.tensor([-1.0, -0.5]).double(),
    "high": torch.tensor([2.0, 1.5]).double(),
}
# Critics with ReLUs are plain MLPs, which have a path of their own on a CPU.
RELU = {"critic_activation": nn.ReLU}
WAYS = {
    "vmap": (UNIT, {}, {}),
    "loop": (BOX, {"num_critics": 3}, {"deactivate_vmap": True}),
    "kernel": (UNIT, RELU, {}),
    "kernel, chunks": (BOX, RELU | {"num_critics": 10}, {"chunk_size": 3}),
    "plain": (BOX, RELU | {"num_critics": 1}, {"chunk_size": None}),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check, check_restated, variant, way
) -> None:
    bounds, critics, options = WAYS[way]
    networks = make_networks(**bounds, **critics)
    restatement = Restatement(networks, **bounds, **VARIANTS[variant])
    loss = make_osr(networks, **VARIANTS[variant], **options)
    expected = restatement.losses(make_batch(10))
    label, _, _ = variant.partition(":")
    check_restated(
        label, loss, losses_of(loss, make_batch(10)), expected, restatement.policy_net,
        restatement.critics, restatement.log_alpha,
    )  # fmt: skip
    if loss.with_lagrange:
        dual = expected["loss_alpha_prime"]
        wanted = torch.autograd.grad(dual, restatement.log_prime)
        check(label, [loss.log_alpha_prime.grad], wanted, tolerance=1e-12)


def test_metrics_say_what_they_are_called(make_networks, make_batch) -> None:
    networks, batch = make_networks(**UNIT), make_batch(10)
    loss, without = make_osr(networks), make_osr(networks, recovery_weight=0.0)
    torch.manual_seed(5)
    out = loss(batch)
    assert out["alpha"].item() == pytest.approx(ALPHA)
    # What the recovery term adds to the policy's loss.
    term = out["loss_actor"] - losses_of(without, batch)["loss_actor"]
    assert term.item() == pytest.approx(0.75 * out["recovery_kl"].item())
    # -log alpha (mean log pi + target): the entropy is what the temperature sees.
    entropy = TARGET_ENTROPY + out["loss_alpha"] / math.log(ALPHA)
    assert out["entropy"].item() == pytest.approx(entropy.item())
    pred = sum(
        critic(batch.clone())["state_action_value"].mean()
        for critic in make_networks().critics
    )
    assert out["pred_value"].item() == pytest.approx(pred.item() / 2)
    restatement = Restatement(networks, **UNIT)
    restatement.losses(batch)
    torch.testing.assert_close(out["target_value"], restatement.target.mean())


def test_a_list_of_one_critic_is_trained(make_networks, make_batch) -> None:
    # TorchRL 0.14.1 by itself would hide its parameters from the optimizer.
    networks = make_networks(num_critics=1)
    loss = make_osr(networks)
    weight = loss.qvalue_network_params["module", "0", "weight"]
    assert torch.equal(weight[0], networks.critics[0].module[0].weight)
    train(loss, make_batch(10), 1)
    assert not torch.equal(weight[0], networks.critics[0].module[0].weight)


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
    for step in range(steps):
        losses = losses_of(loss, batch, seed=step)
        optimizer.zero_grad()
        sum(losses.values()).backward()
        record += [value.detach() for value in losses.values()]
        record += [parameter.grad.clone() for parameter in loss.parameters()]
        optimizer.step()
        updater.step()
    return record + [parameter.detach().clone() for parameter in loss.parameters()]


@pytest.mark.parametrize("with_model", [True, False])
@pytest.mark.parametrize("perturb", [True, False])
def test_cql_is_the_same_to_the_bit_whatever_else_is_given(
    make_networks, make_batch, with_model, perturb
) -> None:
    reference = make_osr(make_networks(), **CQL)
    expected = train(reference, make_batch(10).exclude("perturbed"), 10)
    networks, batch = make_networks(), make_batch(10).exclude("perturbed")
    if not with_model:
        networks.inverse_dynamics = None
    loss = make_osr(networks, **CQL)
    if perturb:
        batch = StatePerturbation(std=0.1)(batch)
    for got, wanted in zip(train(loss, batch, 10), expected, strict=True):
        assert torch.equal(got, wanted)


@pytest.mark.parametrize(
    ("options", "calls"),
    [({}, 1), ({"recovery_weight": 0.0}, 0), ({"recovery_target": "data"}, 0)],
)
def test_model_is_called_once_where_the_policy_is_pulled_to_it(
    make_networks, make_batch, options, calls
) -> None:
    networks, counted = make_networks(), []
    networks.inverse_dynamics[0][0].register_forward_pre_hook(
        lambda *_: counted.append(1)
    )
    make_osr(networks, **options)(make_batch(10))
    assert len(counted) == calls


def test_cloning_in_the_models_place_is_reduced_as_its_divergence(
    family, family_batch, seeded
) -> None:
    found = [
        seeded(family("noisy-cloning", action_reduction=each), batch)["recovery_nll"]
        for batch in [family_batch("noisy-cloning", 10)]
        for each in ("sum", "mean")
    ]
    torch.testing.assert_close(found[1], found[0] / 2)
