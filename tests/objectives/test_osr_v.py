"""OSRVLoss against a plain restatement of its equations, and what (8) means."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal
from torchrl.objectives import SoftUpdate

from torchrl_osr import OSRVLoss

GAMMA, TEMPERATURE, ALPHA, WEIGHT = 0.875, 1.7, 0.3, 2.5
TARGET_ENTROPY, TARGET_SCALE = -1.5, 0.8


def make_osr_v(networks, **kwargs) -> OSRVLoss:
    """A loss with every option off its default and target critics of their own."""
    settings = {
        "recovery_weight": WEIGHT,
        "temperature": TEMPERATURE,
        "alpha_init": ALPHA,
        "target_entropy": TARGET_ENTROPY,
    } | kwargs
    loss = OSRVLoss(
        networks.actor, networks.critics, networks.inverse_dynamics, **settings
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    loss.target_qvalue_network_params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    # The constructor takes the logarithm in float32.
    loss.log_alpha.data.fill_(math.log(ALPHA))
    return loss


def seeded(loss, batch, seed: int = 5):
    torch.manual_seed(seed)
    return loss(batch)


class Restatement:
    """The equations once more: everything in loops, densities by hand."""

    def __init__(self, networks, *, low: Tensor, high: Tensor) -> None:
        networks = copy.deepcopy(networks)
        self.policy_net, self.idm_net = networks.actor[0], networks.inverse_dynamics[0]
        self.critics = [critic.module for critic in networks.critics]
        self.targets = copy.deepcopy(self.critics)
        for target in self.targets:
            for parameter in target.parameters():
                parameter.data.mul_(TARGET_SCALE)
        log_alpha = torch.tensor(math.log(ALPHA), dtype=torch.float64)
        self.log_alpha = log_alpha.requires_grad_()
        self.low, self.half = low, (high - low) / 2

    def act(self, network, inputs, noise: Tensor) -> tuple[Tensor, Tensor]:
        """tanh-Gaussian action and log-density, by the change of variables."""
        _, loc, scale = network(*inputs)
        x = loc + scale * noise
        squashed = torch.tanh(x)
        log_prob = Normal(loc, scale).log_prob(x)
        log_prob = log_prob - torch.log(self.half * (1 - squashed**2))
        return self.low + self.half * (1 + squashed), log_prob.sum(-1)

    def gap(self, critic, states, batch, s_next, number, draws, log_sum_exp) -> Tensor:
        """Equation (8), for a critic: mean over both state sets, ``[B]``.

        Without draws of the model the data's action stands in its place.
        """
        total = 0.0
        for i, state in enumerate(states):
            logits, plain, target = [], 0.0, 0.0
            for k in range(number):
                with torch.no_grad():
                    ours = self.act(self.policy_net, [state], draws["policy"][k, i])
                    theirs = batch["action"]
                    if "model" in draws:
                        inputs, noise = [state, s_next], draws["model"][k, i]
                        theirs, _ = self.act(self.idm_net, inputs, noise)
                value = critic(state, ours[0]).squeeze(-1)
                plain = plain + value / number
                target = target + critic(state, theirs).squeeze(-1) / number
                if log_sum_exp:
                    # Importance weights 1 / p, whatever the temperature.
                    logits.append(value / TEMPERATURE - ours[1])
                    uniform = self.low + 2 * self.half * draws["uniform"][k, i]
                    value = critic(state, uniform).squeeze(-1)
                    box = -torch.log(2 * self.half).sum()
                    logits.append(value / TEMPERATURE - box)
            if log_sum_exp:
                plain = TEMPERATURE * sum(logit.exp() for logit in logits).log()
            total = total + (plain - target) / 2
        return total

    def losses(
        self, batch, seed: int, number: int, log_sum_exp: bool, recovery_target: str
    ) -> dict[str, Tensor]:
        s, a = batch["observation"], batch["action"]
        states = torch.stack([s, batch["perturbed", "observation"]])
        ended = batch["next", "terminated"]
        s_next = torch.where(ended, s, batch["next", "observation"])
        # The draws, in the order in which the loss makes them.
        torch.manual_seed(seed)
        shape, like = (number, 2, *a.shape), {"dtype": torch.float64}
        noise_actor = torch.randn(2, *a.shape, **like)
        draws = {"policy": torch.randn(shape, **like)}
        if recovery_target == "inverse_dynamics":
            draws["model"] = torch.randn(shape, **like)
        if log_sum_exp:
            draws["uniform"] = torch.rand(shape, **like)
        noise_target = torch.randn(*a.shape, **like)

        action, log_prob = self.act(self.policy_net, [states], noise_actor)
        lowest = torch.stack([q(states, action) for q in self.critics]).amin(0)
        alpha = self.log_alpha.detach().exp()
        with torch.no_grad():
            action, _ = self.act(self.policy_net, [s_next], noise_target)
            bootstrap = torch.stack([q(s_next, action) for q in self.targets]).amin(0)
            target = batch["next", "reward"] + GAMMA * bootstrap * ~ended
        valid = ~batch["next", "done"].squeeze(-1)
        td, gap = 0.0, 0.0
        for critic in self.critics:
            td = td + (critic(s, a) - target).square().mean()
            rows = self.gap(critic, states, batch, s_next, number, draws, log_sum_exp)
            gap = gap + rows[valid].mean()
        entropy_gap = log_prob.detach() + TARGET_ENTROPY
        return {
            "loss_actor": (alpha * log_prob - lowest.squeeze(-1)).mean(),
            "loss_alpha": (-self.log_alpha * entropy_gap).mean(),
            "loss_qvalue": td + WEIGHT * gap,
        }


@pytest.mark.parametrize("recovery_target", ["inverse_dynamics", "data"])
@pytest.mark.parametrize("policy_values", ["mean", "logsumexp"])
@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize(
    ("low", "high"), [([-1.0, -1.0], [1.0, 1.0]), ([-1.0, -0.5], [2.0, 1.5])]
)
# Critics with ReLUs are plain MLPs, which have a path of their own.
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
def test_losses_and_gradients_equal_the_restatement(
    make_networks, make_batch, check_restated, policy_values, recovery_target, number,
    low, high, activation,
) -> None:  # fmt: skip
    bounds = {"low": torch.tensor(low).double(), "high": torch.tensor(high).double()}
    networks = make_networks(**bounds, critic_activation=activation)
    batch = make_batch(10)
    restated = Restatement(networks, **bounds)
    options = {"policy_values": policy_values, "recovery_target": recovery_target}
    loss = make_osr_v(networks, num_random=number, **options)
    out = seeded(loss, batch)
    losses = {key: value for key, value in out.items() if key.startswith("loss_")}
    weighed = policy_values == "logsumexp"
    expected = restated.losses(batch, 5, number, weighed, recovery_target)
    label = "OSR-v" + " on the data's actions" * (recovery_target == "data")
    check_restated(
        label, loss, losses, expected, restated.policy_net, restated.critics,
        restated.log_alpha,
    )  # fmt: skip


def test_metrics_say_what_they_are_called(make_networks, make_batch) -> None:
    loss, batch = make_osr_v(make_networks()), make_batch(10)
    out = seeded(loss, batch)
    assert out["alpha"].item() == pytest.approx(ALPHA)
    assert not out["recovery_gap"].requires_grad
    # What the constraint adds to the critics' loss.
    loss.recovery_weight = 0.0
    added = out["loss_qvalue"] - seeded(loss, batch)["loss_qvalue"]
    assert added.item() == pytest.approx(WEIGHT * out["recovery_gap"].item())
    entropy = TARGET_ENTROPY + out["loss_alpha"] / math.log(ALPHA)
    assert out["entropy"].item() == pytest.approx(entropy.item())


def test_model_is_called_once_and_perturbed_states_matter(
    make_networks, make_batch
) -> None:
    networks, called = make_networks(), []
    networks.inverse_dynamics[0][0].register_forward_pre_hook(
        lambda *_: called.append(1)
    )
    loss, batch = make_osr_v(networks), make_batch(10)
    before = seeded(loss, batch)["recovery_gap"]
    assert len(called) == 1
    batch["perturbed", "observation"] += 1.0
    assert seeded(loss, batch)["recovery_gap"] != before
