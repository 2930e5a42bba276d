"""What the restatements of the losses share: networks in loops, densities by hand.

No function of torchrl_osr is called here.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from objectives.losses import Networks, density, parts
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Normal
from torchrl.objectives import LossModule

GAMMA, ALPHA, TARGET_ENTROPY, TARGET_SCALE = 0.875, 0.3, -1.5, 0.8
SOFT = {"alpha_init": ALPHA, "target_entropy": TARGET_ENTROPY}
# Tensors in float64: TorchRL would keep numbers in float32, to 1e-8 only.
UNIT = {"low": -torch.ones(2).double(), "high": torch.ones(2).double()}
LOW, HIGH = torch.tensor([[-1.0, -1.5], [2.0, 1.0]]).double()
BOX = {"low": LOW, "high": HIGH}


def prepare(loss: LossModule) -> LossModule:
    """Give a loss numbers off its defaults and targets of their own."""
    part = parts(loss)[0]
    part.make_value_estimator(gamma=GAMMA)
    for name, params in part.named_children():
        if name.startswith("target_"):
            params.data.apply_(lambda each: each.mul_(TARGET_SCALE))
    if hasattr(part, "log_alpha"):  # whose logarithm was taken in float32
        part.log_alpha.data.fill_(math.log(ALPHA))
    if hasattr(part, "log_alpha_prime"):
        part.log_alpha_prime.data.fill_(LOG_PRIME)
    return loss


class Plain:
    """Copies of a loss's networks.

    Attributes:
        actor, critics: the networks.
        old_actor, targets: with the targets' weights.
        log_alpha: of the entropy temperature.
    """

    def __init__(self, networks: Networks, actor: str = "actor") -> None:
        pair = getattr(networks, actor), networks.critics
        self.actor, self.critics = copy.deepcopy(pair)
        self.old_actor, self.targets = copy.deepcopy(pair)
        for network in (self.old_actor, *self.targets):
            for parameter in network.parameters():
                parameter.data.mul_(TARGET_SCALE)
        self.log_alpha = torch.tensor(math.log(ALPHA), dtype=torch.float64)
        self.log_alpha.requires_grad_()
        low, high = (torch.as_tensor(b).double() for b in networks.bounds.values())
        self.center, self.half = (high + low) / 2, (high - low) / 2

    @property
    def networks(self) -> dict[str, Any]:
        """What :func:`compare` is to compare of a soft actor-critic loss."""
        return {
            "loss_actor loss_recovery actor": self.actor,
            "loss_qvalue loss_cql qvalue": self.critics,
            "loss_alpha log_alpha": self.log_alpha,
        }

    def policy(self, state: Tensor) -> Normal:
        return density(self.actor, state)

    def act(self, gaussian: Normal, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return a tanh-Gaussian action and its log-density."""
        x = gaussian.loc + gaussian.scale * noise
        squashed = torch.tanh(x)
        log_prob = gaussian.log_prob(x) - torch.log(self.half * (1 - squashed**2))
        return self.center + self.half * squashed, log_prob.sum(-1)

    def log_prob(self, gaussian: Normal, action: Tensor) -> Tensor:
        """Return the log-density of an action, by the change of variables."""
        squashed = (action - self.center) / self.half
        log_prob = gaussian.log_prob(torch.atanh(squashed))
        return (log_prob - torch.log(self.half * (1 - squashed**2))).sum(-1)

    def values(self, state: Tensor, action: Tensor, critics: Any = None) -> Tensor:
        """Return the values of all critics, one by one, ``[N, ...]``."""
        critics = critics or self.critics
        rows = torch.cat([state, action], -1)
        return torch.stack([each.module(rows).squeeze(-1) for each in critics])

    def policy_losses(self, states: Tensor) -> dict[str, Tensor]:
        """Return SAC's losses of policy and temperature on states ``[D, R, S]``."""
        noise = torch.randn(*states.shape[:-1], 2, dtype=torch.float64)
        action, log_prob = self.act(self.policy(states), noise)
        lowest = self.values(states, action).amin(0)
        alpha, gap = self.log_alpha.detach().exp(), log_prob.detach() + TARGET_ENTROPY
        return {
            "loss_actor": (alpha * log_prob - lowest).mean(),
            "loss_alpha": (-self.log_alpha * gap).mean(),
        }

    @torch.no_grad()
    def soft_value(self, batch, *, entropy: bool, number: int = 1) -> Tensor:
        """Return what SAC's target bootstraps from, the best of a number, ``[R]``."""
        state, best, of_best = following(batch), torch.tensor(-math.inf), 0.0
        for noise in torch.randn(number, len(state), 2, dtype=torch.float64):
            action, log_prob = self.act(self.policy(state), noise)
            lowest = self.values(state, action, self.targets).amin(0)
            of_best = torch.where(lowest > best, log_prob, of_best)
            best = torch.maximum(lowest, best)
        return best - ALPHA * of_best if entropy else best

    def td_loss(self, batch: TensorDict, next_value: Tensor) -> Tensor:
        """Return the squared TD error, summed over critics."""
        alive = 1 - batch["next", "terminated"].squeeze(-1).double()
        target = batch["next", "reward"].squeeze(-1) + GAMMA * alive * next_value
        error = self.values(batch["observation"], batch["action"]) - target.detach()
        return error.square().mean(-1).sum()


def following(batch: TensorDict) -> Tensor:
    """Return the next states; where there is none any finite stand-in will do."""
    ended = batch["next", "terminated"]
    return torch.where(ended, batch["observation"], batch["next", "observation"])


K, LOG_PRIME, WEIGHT = 3, 0.4, 2.5
DEFAULTS = SOFT | {"temperature": 1.7, "min_q_weight": WEIGHT, "num_random": K}
DEFAULTS |= {"clip_diff_min": -math.inf, "target_action_gap": None}
DEFAULTS |= {"max_q_backup": False, "deterministic_backup": True}


class PlainCQL(Plain):
    """CQL(H): all sampled actions of a row in one log-sum-exp."""

    def __init__(self, networks: Networks, **options) -> None:
        super().__init__(networks)
        self.options = DEFAULTS | options
        self.log_prime = torch.tensor(LOG_PRIME, dtype=torch.float64).requires_grad_()

    def losses(self, batch, states: Tensor) -> dict[str, Tensor]:
        """Return the losses with the policy's values on states ``[D, R, S]``."""
        losses = self.policy_losses(states)
        # The conservative term's actions are drawn before the target's.
        if self.options["min_q_weight"]:
            losses |= self.conservative_losses(batch)
        entropy = not self.options["deterministic_backup"]
        number = K if self.options["max_q_backup"] else 1
        value = self.soft_value(batch, entropy=entropy, number=number)
        return losses | {"loss_qvalue": self.td_loss(batch, value)}

    @torch.no_grad()
    def proposals(self, batch) -> list[tuple[Tensor, Tensor]]:
        s, a = batch["observation"], batch["action"]
        uniform = 2 * torch.rand(K, *a.shape, dtype=a.dtype) - 1
        box = -torch.log(2 * self.half).sum()
        found = [(self.center + self.half * each, box) for each in uniform]
        for noise in torch.randn(K, 2, *a.shape, dtype=a.dtype):
            found.append(self.act(self.policy(s), noise[0]))
            found.append(self.act(self.policy(following(batch)), noise[1]))
        return found

    def conservative_losses(self, batch) -> dict[str, Tensor]:
        s, o, gaps = batch["observation"], self.options, []
        tau, proposals = o["temperature"], self.proposals(batch)
        for critic in self.critics:
            # Importance weights 1 / p, whatever the temperature.
            terms = sum(
                (self.values(s, x, [critic])[0] / tau).exp() / density.exp()
                for x, density in proposals
            )
            gap = tau * terms.log() - self.values(s, batch["action"], [critic])[0]
            gaps.append(gap.clamp(min=o["clip_diff_min"]).mean())
        if o["target_action_gap"] is None:
            return {"loss_cql": WEIGHT * sum(gaps)}
        # CORL: half the sum over two critics, both sides of one product.
        gaps = [gap - o["target_action_gap"] for gap in gaps]
        slack = sum(gap.detach() for gap in gaps) / len(gaps)
        return {
            "loss_cql": WEIGHT * math.exp(LOG_PRIME) * sum(gaps),
            "loss_alpha_prime": -WEIGHT * self.log_prime.exp() * slack,
        }

    @property
    def networks(self) -> dict[str, Any]:
        found = super().networks
        if self.options["target_action_gap"] is not None:
            found["loss_alpha_prime log_alpha_prime"] = self.log_prime
        return found


def compare(
    check, label: str, loss: LossModule, batch, restated, networks, tolerance=1e-12
) -> TensorDict:
    """Compare a loss with its restatement: values, and gradients of their sums.

    ``restated`` returns the losses anew, from the same draws. The restated networks (a
    list of critics) are named by the losses that train them and the name in the loss:
    ``{"loss_qvalue loss_cql qvalue": critics}``.
    """
    torch.manual_seed(5)
    out = loss(batch)
    torch.manual_seed(5)
    expected, part = restated(), parts(loss)[0]
    losses = {key: value for key, value in out.items() if key.startswith("loss_")}
    assert set(losses) == set(expected)
    found = [losses[key] for key in expected]
    check(label, found, expected.values(), tolerance=tolerance)
    sum(losses.values()).backward()
    ours, wanted = [], []
    for names, network in networks.items():
        *keys, name = names.split()
        total = sum(expected[key] for key in keys if key in expected)
        if isinstance(network, Tensor):
            wanted += torch.autograd.grad(total, network, retain_graph=True)
            owner = next(each for each in (part, *parts(loss)) if hasattr(each, name))
            ours.append(getattr(owner, name).grad)
            continue
        held = getattr(part, f"{name}_network_params").flatten_keys(".")
        copies = network if isinstance(network, list) else [network]
        for key, parameter in copies[0].named_parameters():
            each = [dict(other.named_parameters())[key] for other in copies]
            if not parameter.requires_grad:
                continue
            slopes = torch.autograd.grad(total, each, retain_graph=True)
            wanted.append(torch.stack(slopes) if network is copies else slopes[0])
            ours.append(held[key].grad)
    check(label, ours, wanted, tolerance=tolerance)
    return out
