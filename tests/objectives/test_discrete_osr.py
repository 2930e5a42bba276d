"""DiscreteOSRLoss against a plain restatement of its equations, and by hand."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, kl_divergence
from torchrl.modules import OneHotCategorical, ProbabilisticActor
from torchrl.objectives import SoftUpdate

from torchrl_osr import DiscreteOSRLoss

GAMMA, TEMPERATURE, ALPHA = 0.875, 1.7, 0.3
MIN_Q_WEIGHT, TARGET_ENTROPY, TARGET_SCALE = 2.5, 0.4, 0.8


def make_loss(networks, **kwargs) -> DiscreteOSRLoss:
    """A loss with every number off its default and target critics of their own."""
    settings = {
        "recovery_weight": 0.75,
        "min_q_weight": MIN_Q_WEIGHT,
        "temperature": TEMPERATURE,
        "alpha_init": ALPHA,
        "target_entropy": TARGET_ENTROPY,
    } | kwargs
    loss = DiscreteOSRLoss(
        networks.actor, networks.critics, networks.inverse_dynamics, **settings
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    return loss


class Restatement:
    """The equations once more: actions and critics in loops, no torchrl_osr."""

    def __init__(
        self,
        networks,
        *,
        recovery_weight: float = 0.75,
        recovery_direction: str = "forward",
        recovery_states: str = "both",
        actor_states: str = "both",
    ) -> None:
        networks = copy.deepcopy(networks)
        self.policy_net = networks.actor[0].module
        self.model_net = networks.inverse_dynamics[0].module
        self.critics = [critic.module for critic in networks.critics]
        self.targets = copy.deepcopy(self.critics)
        for target in self.targets:
            for parameter in target.parameters():
                parameter.data.mul_(TARGET_SCALE)
        # As the constructor takes the logarithm, in float32.
        self.log_alpha = torch.tensor(math.log(ALPHA)).double().requires_grad_()
        self.weight, self.forward = recovery_weight, recovery_direction == "forward"
        # Of the clean and the perturbed states, those that count.
        rows = {"clean": slice(0, 1), "perturbed": slice(1, 2), "both": slice(0, 2)}
        self.recovery_rows, self.actor_rows = rows[recovery_states], rows[actor_states]

    def policy(self, state: Tensor) -> Categorical:
        return Categorical(logits=self.policy_net(state))

    def expectation(self, policy: Categorical, values: list[Tensor]) -> Tensor:
        """Sum over actions of pi(a) values[a]."""
        return sum(policy.probs[..., a] * value for a, value in enumerate(values))

    def lowest(self, critics: list[nn.Module], state: Tensor) -> list[Tensor]:
        values = torch.stack([critic(state) for critic in critics]).amin(0)
        return list(values.unbind(-1))

    def losses(self, batch: TensorDict) -> dict[str, Tensor]:
        s, index = batch["observation"], batch["action"].argmax(-1)
        reward = batch["next", "reward"].squeeze(-1)
        done = batch["next", "done"].squeeze(-1)
        terminated = batch["next", "terminated"]
        # Rows without a next state never reach a network; any finite stand-in will do.
        s_next = torch.where(terminated, s, batch["next", "observation"])
        s_tot = torch.stack([s, batch["perturbed", "observation"]])
        s_actor = s_tot[self.actor_rows]

        pi, alpha = self.policy(s_actor), self.log_alpha.detach().exp()
        log_prob = [pi.logits[..., a] for a in range(pi.logits.shape[-1])]
        lowest = self.lowest(self.critics, s_actor)
        scores = [alpha * p - q for p, q in zip(log_prob, lowest, strict=True)]
        entropy = -self.expectation(pi, log_prob).detach()
        losses = {
            "loss_actor": self.expectation(pi, scores).mean(),
            "loss_alpha": (-self.log_alpha * (TARGET_ENTROPY - entropy)).mean(),
        }
        with torch.no_grad():
            next_values = self.lowest(self.targets, s_next)
            bootstrap = self.expectation(self.policy(s_next), next_values)
            target = reward + GAMMA * (1 - terminated.squeeze(-1).double()) * bootstrap
        td, gap = 0.0, 0.0
        for critic in self.critics:
            values = critic(s)
            pred = torch.stack([row[i] for row, i in zip(values, index, strict=True)])
            td = td + (pred - target) ** 2
            gap = gap + TEMPERATURE * (values / TEMPERATURE).exp().sum(-1).log() - pred
        losses |= {"loss_qvalue": td.mean(), "loss_cql": MIN_Q_WEIGHT * gap.mean()}
        if self.weight:
            s_kl = s_tot[self.recovery_rows]
            with torch.no_grad():
                pair = torch.cat([s_kl, s_next.expand_as(s_kl)], -1)
                model = Categorical(logits=self.model_net(pair))
            ours = self.policy(s_kl)
            order = (model, ours) if self.forward else (ours, model)
            kl = kl_divergence(*order).mean(0)
            losses["loss_actor"] += self.weight * kl[~done].mean()
        return losses


OPTIONS = [
    {},
    {"recovery_weight": 0.0, "actor_states": "clean"},
    {"recovery_weight": 0.0},
    {"recovery_direction": "reverse"},
    {"recovery_states": "perturbed"},
    {"recovery_states": "clean", "actor_states": "perturbed"},
    {"actor_states": "clean"},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_losses_and_gradients_equal_the_restatement(
    make_discrete_networks, make_discrete_batch, check_restated, options
) -> None:
    networks, batch = make_discrete_networks(), make_discrete_batch(10)
    restatement = Restatement(networks, **options)
    loss = make_loss(networks, **options)
    losses = {k: v for k, v in loss(batch).items() if k.startswith("loss_")}
    expected = restatement.losses(batch)
    label = "Discrete OSR" if restatement.weight else "Discrete CQL(H)"
    check_restated(
        label, loss, losses, expected, restatement.policy_net, restatement.critics,
        restatement.log_alpha,
    )  # fmt: skip


@pytest.mark.parametrize("number", [1, 3])
def test_metrics_and_priority(
    make_discrete_networks, make_discrete_batch, number
) -> None:
    networks = make_discrete_networks(num_critics=number)
    loss, batch = make_loss(networks), make_discrete_batch(10)
    out = loss(batch)
    assert out["alpha"].item() == pytest.approx(ALPHA)
    # What the recovery term adds to the policy's loss.
    loss.recovery_weight = 0.0
    added = out["loss_actor"] - loss(batch)["loss_actor"]
    torch.testing.assert_close(added.detach(), 0.75 * out["recovery_kl"])
    states = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    policy = Categorical(logits=networks.actor[0].module(states))
    torch.testing.assert_close(out["entropy"], policy.entropy().mean())
    index = batch["action"].argmax(-1, keepdim=True)
    pred = torch.stack(
        [critic.module(states[0]).gather(-1, index) for critic in networks.critics]
    ).squeeze(-1)
    torch.testing.assert_close(out["pred_value"], pred.mean())
    loss.make_value_estimator(gamma=0.0)
    loss(batch)
    error = (pred - batch["next", "reward"].squeeze(-1)).abs().amax(0)
    torch.testing.assert_close(batch["td_error"], error.detach())


def table_of_values(values: list[list[float]]) -> TensorDictModule:
    """A critic whose weights are the values of all states and actions."""
    layer = nn.Linear(len(values), len(values[0]), bias=False)
    layer.weight.data = torch.tensor(values).T.clone()
    return TensorDictModule(layer, ["observation"], ["action_value"])


def test_two_states_and_two_actions_by_hand() -> None:
    logits = nn.Linear(2, 2, bias=False)
    # pi(s0) = (1/2, 1/2) and pi(s1) = (1/4, 3/4).
    logits.weight.data = torch.tensor([[0.0, 0.0], [0.0, math.log(3.0)]])
    actor = ProbabilisticActor(
        TensorDictModule(logits, ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=OneHotCategorical,
    )
    critics = [
        table_of_values([[1.0, 2.0], [0.0, 3.0]]),
        table_of_values([[0.0, 5.0], [4.0, 2.0]]),
    ]
    loss = DiscreteOSRLoss(
        actor,
        critics,
        recovery_weight=0.0,
        actor_states="clean",
        min_q_weight=2.0,
        alpha_init=0.5,
        delay_qvalue=False,
    )
    loss.make_value_estimator(gamma=0.5)
    s0, s1 = torch.eye(2)
    # s0 -a1-> s1 with reward 1; s1 -a0-> the end with reward 1/2.
    batch = TensorDict(
        {
            "observation": torch.stack([s0, s1]),
            "action": torch.eye(2)[[1, 0]],
            "next": {
                "observation": torch.stack([s1, s0]),
                "reward": torch.tensor([[1.0], [0.5]]),
                "done": torch.tensor([[False], [True]]),
                "terminated": torch.tensor([[False], [True]]),
            },
        },
        [2],
    )
    out = loss(batch)
    # min Q = (0, 2) at s0 and (0, 2) at s1: V(s1) = 3/2, targets 1 + 3/4 and 1/2.
    assert out["target_value"].item() == pytest.approx((1.75 + 0.5) / 2)
    # Errors 2 - 1.75 and 0 - .5 of the first critic, 5 - 1.75 and 4 - .5 of the other.
    td = (0.25**2 + 0.5**2 + 3.25**2 + 3.5**2) / 2
    assert out["loss_qvalue"].item() == pytest.approx(td)
    # log(1 + e^-1), 3 + log(1 + e^-3), log(1 + e^-5), log(1 + e^-2).
    gap = (0.3132617 + 3.0485874 + 0.0067153 + 0.1269280) / 2
    assert out["loss_cql"].item() == pytest.approx(2.0 * gap, abs=1e-6)
    # log 2 and log(4) / 4 + 3 log(4/3) / 4, halved by alpha; values 1 and 3/2.
    entropies = 0.6931472, 0.5623351
    actor_loss = (-0.5 * sum(entropies) - 2.5) / 2
    assert out["loss_actor"].item() == pytest.approx(actor_loss)
    alpha_loss = 0.6931472 * (0.98 * 0.6931472 - sum(entropies) / 2)
    assert out["loss_alpha"].item() == pytest.approx(alpha_loss, abs=1e-6)


@pytest.mark.parametrize(
    ("option", "entropy"), [(0.25, 0.25), ("auto", 0.5 * math.log(4))]
)
def test_target_entropy_is_a_number_or_a_share_of_the_uniform_policys(
    make_discrete_networks, make_discrete_batch, option, entropy
) -> None:
    loss = make_loss(
        make_discrete_networks(), target_entropy=option, target_entropy_weight=0.5
    )
    out = loss(make_discrete_batch(10))
    expected = -math.log(ALPHA) * (entropy - out["entropy"])
    torch.testing.assert_close(out["loss_alpha"], expected, rtol=1e-6, atol=1e-6)
