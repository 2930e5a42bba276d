"""The OSR update in plain PyTorch, as a single-file library writes it.

What ``update_speed.py`` compares ours with: CQL(H) and the recovery term with a frozen
inverse dynamics model, the mathematics of ``OSRLoss`` with its defaults
(``tests/benchmarks/test_plain_reference.py``). The two critics are modules of their
own, called once for each kind of action; states are repeated for every sampled action,
and the policy runs on the repeated rows, as in CORL's ``cql.py``
(https://github.com/corl-team/CORL). Actor, temperature and critics have optimizers of
their own, PyTorch's plain Adam; targets are moved by a loop.

Nothing is slow on purpose: what needs no gradient records none, states are repeated
once, not for each call, and nothing is logged.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.nn.functional import mse_loss, softplus

MIN_SCALE = 0.01
# A softplus that is 1 at 0; in float32, as tensordict computes it.
SHIFT = torch.tensor(1.0 - MIN_SCALE).expm1().log().item()


class Batch(NamedTuple):
    """Transitions: states ``[B, S]``, actions ``[B, A]``, the rest ``[B]``."""

    state: Tensor
    action: Tensor
    reward: Tensor
    next_state: Tensor
    done: Tensor
    terminated: Tensor
    perturbed: Tensor


class Noise(NamedTuple):
    """The draws of an update: normal, and uniform in [-1, 1]; ``K`` actions a row."""

    actor: Tensor  # [2B, A]
    target: Tensor  # [B, A]
    uniform: Tensor  # [BK, A]
    current: Tensor  # [BK, A]
    next: Tensor  # [BK, A]


def mlp(
    inputs: int, outputs: int, cells: Sequence[int], *, layer_norm: bool = False
) -> nn.Sequential:
    """Linear layers with ReLU between them, and layer normalisation before it."""
    layers: list[nn.Module] = []
    for before, after in pairwise([inputs, *cells]):
        norm = [nn.LayerNorm(after)] if layer_norm else []
        layers += [nn.Linear(before, after), *norm, nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(cells[-1], outputs))


class Gaussian(nn.Module):
    """Normal distribution before the tanh, of policy or inverse dynamics model."""

    def __init__(self, inputs: int, actions: int, cells: Sequence[int]) -> None:
        super().__init__()
        self.net = mlp(inputs, 2 * actions, cells)

    def forward(self, *inputs: Tensor) -> Normal:
        loc, raw = self.net(torch.cat(inputs, -1)).chunk(2, -1)
        return Normal(loc, softplus(raw + SHIFT) + MIN_SCALE)


class Critic(nn.Module):
    """One value a row."""

    def __init__(
        self,
        observations: int,
        actions: int,
        cells: Sequence[int],
        *,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        self.net = mlp(observations + actions, 1, cells, layer_norm=layer_norm)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.net(torch.cat([state, action], -1)).squeeze(-1)


def act(gaussian: Normal, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Tanh-Gaussian action ``[rows, A]`` and its log-density ``[rows]``."""
    x = gaussian.loc + gaussian.scale * noise
    log_slope = 2 * (math.log(2) - x - softplus(-2 * x))
    return torch.tanh(x), (gaussian.log_prob(x) - log_slope).sum(-1)


class PlainOSR:
    """Networks, optimizers and the update.

    Args:
        observations, actions: sizes of a state and of an action.
        cells: widths of the hidden layers of all networks.
        num_random: ``K``, actions drawn of each kind.
        layer_norm: whether the critics have layer normalisation.
        device: of all of it.
        autocast: whether losses are computed under bfloat16 autocast.
    """

    recovery_weight, min_q_weight, gamma, tau, rate = 0.5, 5.0, 0.99, 5e-3, 3e-4

    def __init__(
        self,
        observations: int,
        actions: int,
        cells: Sequence[int],
        *,
        num_random: int = 10,
        layer_norm: bool = False,
        device: torch.device | str = "cpu",
        autocast: bool = False,
    ) -> None:
        self.device, self.autocast = torch.device(device), autocast
        self.num_random, self.target_entropy = num_random, -float(actions)
        self.actor = Gaussian(observations, actions, cells).to(device)
        self.inverse_dynamics = Gaussian(2 * observations, actions, cells).to(device)
        self.critic_1, self.critic_2 = (
            Critic(observations, actions, cells, layer_norm=layer_norm).to(device)
            for _ in range(2)
        )
        self.target_1 = copy.deepcopy(self.critic_1).requires_grad_(False)
        self.target_2 = copy.deepcopy(self.critic_2).requires_grad_(False)
        self.log_alpha = torch.zeros((), device=device, requires_grad=True)
        critics = [*self.critic_1.parameters(), *self.critic_2.parameters()]
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), self.rate)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], self.rate)
        self.critic_optimizer = torch.optim.Adam(critics, self.rate)

    def draw(self, action: Tensor) -> Noise:
        """Draw the noise of one update for actions like these, ``[B, A]``."""
        rows, size = action.shape
        many = rows * self.num_random
        return Noise(
            actor=action.new_empty(2 * rows, size).normal_(),
            target=action.new_empty(rows, size).normal_(),
            uniform=action.new_empty(many, size).uniform_(-1, 1),
            current=action.new_empty(many, size).normal_(),
            next=action.new_empty(many, size).normal_(),
        )

    def losses(self, batch: Batch, noise: Noise) -> dict[str, Tensor]:
        """All terms, under the names that ``OSRLoss`` gives them."""
        # A terminated row's next state is not one; any finite stand-in does.
        ended = batch.terminated.unsqueeze(-1)
        batch = batch._replace(
            next_state=torch.where(ended, batch.state, batch.next_state)
        )
        return self.actor_losses(batch, noise) | self.critic_losses(batch, noise)

    def actor_losses(self, batch: Batch, noise: Noise) -> dict[str, Tensor]:
        """Terms of the policy, on clean and perturbed states."""
        states = torch.cat([batch.state, batch.perturbed])
        policy = self.actor(states)
        action, log_prob = act(policy, noise.actor)
        value = torch.min(self.critic_1(states, action), self.critic_2(states, action))
        with torch.no_grad():
            target = self.inverse_dynamics(states, batch.next_state.repeat(2, 1))
        divergence = kl_divergence(target, policy).sum(-1)
        kept = (~batch.done).to(divergence).repeat(2)
        recovery = (divergence * kept).sum() / kept.sum()
        alpha = self.log_alpha.detach().exp()
        objective = (alpha * log_prob - value).mean()
        temperature = self.log_alpha * (log_prob.detach() + self.target_entropy)
        return {
            "loss_actor": objective + self.recovery_weight * recovery,
            "loss_alpha": -temperature.mean(),
        }

    def critic_losses(self, batch: Batch, noise: Noise) -> dict[str, Tensor]:
        """Terms of the critics: the TD error and CQL's."""
        repeated = batch.state.repeat_interleave(self.num_random, 0)
        with torch.no_grad():
            next_action, _ = act(self.actor(batch.next_state), noise.target)
            next_value = torch.min(
                self.target_1(batch.next_state, next_action),
                self.target_2(batch.next_state, next_action),
            )
            alive = (~batch.terminated).to(next_value)
            target = batch.reward + self.gamma * alive * next_value
            uniform_density = -noise.uniform.shape[-1] * math.log(2)
            next_repeated = batch.next_state.repeat_interleave(self.num_random, 0)
            proposals = [
                (noise.uniform, uniform_density),
                act(self.actor(repeated), noise.current),
                act(self.actor(next_repeated), noise.next),
            ]
        td_error, gap = 0.0, 0.0
        for critic in (self.critic_1, self.critic_2):
            value = critic(batch.state, batch.action)
            logits = [
                (critic(repeated, action) - density).view(-1, self.num_random)
                for action, density in proposals
            ]
            soft_maximum = torch.logsumexp(torch.cat(logits, -1), -1)
            td_error = td_error + mse_loss(value, target)
            gap = gap + (soft_maximum - value).mean()
        return {"loss_qvalue": td_error, "loss_cql": self.min_q_weight * gap}

    def update(self, batch: Batch) -> Iterator[str]:
        """Do one update; name each part when it is done."""
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.autocast):
            losses = self.losses(batch, self.draw(batch.action))
            critics = losses["loss_qvalue"] + losses["loss_cql"]
        yield "forward"
        # The policy's backward leaves gradients in the critics, as it does in such
        # libraries: theirs comes last, and clears them first.
        for optimizer, loss in (
            (self.alpha_optimizer, losses["loss_alpha"]),
            (self.actor_optimizer, losses["loss_actor"]),
            (self.critic_optimizer, critics),
        ):
            optimizer.zero_grad()
            loss.backward()
            yield "backward"
            optimizer.step()
            yield "optimizer"
        self.move_targets()
        yield "targets"

    @torch.no_grad()
    def move_targets(self) -> None:
        """Move the target critics a little towards the critics."""
        for critic, target in (
            (self.critic_1, self.target_1),
            (self.critic_2, self.target_2),
        ):
            pairs = zip(critic.parameters(), target.parameters(), strict=True)
            for source, moved in pairs:
                moved.mul_(1 - self.tau).add_(source, alpha=self.tau)
