"""OSR in plain PyTorch: one page to read with the paper.

The page follows the paper: perturbed states, the inverse dynamics model (4.2), state
recovery (11), the actor and the critics (4.4), one update. It computes the losses and
gradients of ``torchrl_osr.OSRLoss`` with default options, which
``tests/examples/test_plain_osr.py`` checks. ``python plain_osr.py`` trains on a toy.

Shapes: ``B`` rows of a batch, ``S`` state, ``A`` action in [-1, 1], ``K`` sampled
actions of each kind.
"""

import copy
import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.nn.functional import mse_loss, softplus

MIN_SCALE = 0.01
SHIFT = torch.tensor(1.0 - MIN_SCALE).expm1().log().item()  # softplus(SHIFT) is 0.99


class Batch(NamedTuple):
    """Transitions: states ``[B, S]``, actions ``[B, A]``, the rest ``[B]``."""

    state: Tensor
    action: Tensor
    reward: Tensor
    next_state: Tensor
    done: Tensor  # the episode ended: next_state may belong to another one
    terminated: Tensor  # it ended in a terminal state, whose value is 0
    perturbed: Tensor  # s + noise, N(0, std^2)


def unpack(batch) -> Batch:
    """Return a TorchRL batch with perturbed states as this page reads it."""
    following = batch["next"]
    return Batch(
        batch["observation"],
        batch["action"],
        following["reward"].squeeze(-1),
        following["observation"],
        following["done"].squeeze(-1),
        following["terminated"].squeeze(-1),
        batch["perturbed", "observation"],
    )


class Noise(NamedTuple):
    """Random draws of one update: standard normal; ``uniform`` in [-1, 1]."""

    actor: Tensor  # [2B, A]
    target: Tensor  # [B, A]
    uniform: Tensor  # [BK, A]
    current: Tensor  # [BK, A]
    next: Tensor  # [BK, A]


def mlp(inputs: int, outputs: int, cells: list[int], norm: bool = False):
    """Return linear layers with ReLU, and optionally layer normalisation, between."""
    layers = []
    for before, after in pairwise([inputs, *cells]):
        layers += [nn.Linear(before, after), *[nn.LayerNorm(after)] * norm, nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(cells[-1], outputs))


class Gaussian(nn.Module):
    """Distribution before the tanh: policy pi(a | s) or model I(a | s, s')."""

    def __init__(self, inputs: int, actions: int, cells: list[int]):
        super().__init__()
        self.net = mlp(inputs, 2 * actions, cells)

    def forward(self, *inputs: Tensor) -> Normal:
        loc, raw = self.net(torch.cat(inputs, -1)).chunk(2, -1)
        return Normal(loc, softplus(raw + SHIFT) + MIN_SCALE)


class Critic(nn.Module):
    """Q(s, a)."""

    def __init__(self, states: int, actions: int, cells: list[int], norm: bool):
        super().__init__()
        self.net = mlp(states + actions, 1, cells, norm)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.net(torch.cat([state, action], -1)).squeeze(-1)


def log_density(gaussian: Normal, x: Tensor) -> Tensor:
    """Return the log-density of the action tanh(x), ``[rows]``."""
    log_slope = 2 * (math.log(2) - x - softplus(-2 * x))  # log(1 - tanh(x)^2)
    return (gaussian.log_prob(x) - log_slope).sum(-1)


def sample(gaussian: Normal, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return an action ``[rows, A]`` and its log-density ``[rows]``."""
    x = gaussian.loc + gaussian.scale * noise
    return torch.tanh(x), log_density(gaussian, x)


class PlainOSR:
    """Networks, losses and one update of OSR."""

    recovery_weight, min_q_weight, gamma, tau, rate = 0.5, 5.0, 0.99, 5e-3, 3e-4

    def __init__(self, states, actions, cells, *, num_random=10, layer_norm=False):
        self.num_random, self.target_entropy = num_random, -float(actions)
        self.inverse_dynamics = Gaussian(2 * states, actions, cells)
        self.actor = Gaussian(states, actions, cells)
        self.critics = [Critic(states, actions, cells, layer_norm) for _ in range(2)]
        self.targets = copy.deepcopy(self.critics)
        self.log_alpha = torch.zeros((), requires_grad=True)
        weights = [weight for each in self.critics for weight in each.parameters()]
        adam = torch.optim.Adam
        self.model_optimizer = adam(self.inverse_dynamics.parameters(), 1e-3)
        self.actor_optimizer = adam(self.actor.parameters(), self.rate)
        self.alpha_optimizer = adam([self.log_alpha], self.rate)
        self.critic_optimizer = adam(weights, self.rate)

    def inverse_dynamics_loss(self, batch: Batch) -> Tensor:
        """Section 4.2: -log I(a | s~, s') over the states of D_tot = {s, s_perturbed}.

        Rows at the end of an episode do not count: their s' may be another episode's.
        """
        states = torch.cat([batch.state, batch.perturbed])
        model = self.inverse_dynamics(states, batch.next_state.repeat(2, 1))
        log_prob = log_density(model, batch.action.atanh().repeat(2, 1))
        kept = (~batch.done).repeat(2)
        return -log_prob[kept].mean()

    def draw(self, action: Tensor) -> Noise:
        """Draw the noise of an update for actions ``[B, A]``."""
        rows, size = action.shape
        many = rows * self.num_random
        normal = [torch.randn(n, size) for n in (2 * rows, rows, many, many)]
        return Noise(*normal[:2], 2 * torch.rand(many, size) - 1, *normal[2:])

    def losses(self, batch: Batch, noise: Noise) -> dict[str, Tensor]:
        """Return all terms under the names of ``OSRLoss``."""
        # The value of a terminal state is 0: any finite state can replace it.
        ended = batch.terminated.unsqueeze(-1)
        next_state = torch.where(ended, batch.state, batch.next_state)
        batch = batch._replace(next_state=next_state)
        return self.actor_losses(batch, noise) | self.critic_losses(batch, noise)

    def actor_losses(self, batch: Batch, noise: Noise) -> dict[str, Tensor]:
        """Section 4.4: E over D_tot of alpha log pi - min_i Q_i, plus (11)."""
        states = torch.cat([batch.state, batch.perturbed])  # [2B, S]
        policy = self.actor(states)
        action, log_prob = sample(policy, noise.actor)
        value = torch.min(*(critic(states, action) for critic in self.critics))
        alpha = self.log_alpha.detach().exp()

        # (11): KL(I(. | s~, s') || pi(. | s~)). Tanh is a bijection: KL before it.
        with torch.no_grad():
            model = self.inverse_dynamics(states, batch.next_state.repeat(2, 1))
        divergence = kl_divergence(model, policy).sum(-1)
        kept = (~batch.done).to(divergence).repeat(2)
        recovery = (divergence * kept).sum() / kept.sum()

        actor = (alpha * log_prob - value).mean() + self.recovery_weight * recovery
        temperature = self.log_alpha * (log_prob.detach() + self.target_entropy)
        return {"loss_actor": actor, "loss_alpha": -temperature.mean()}

    def critic_losses(self, batch: Batch, noise: Noise) -> dict[str, Tensor]:
        """Section 4.4: sum_i (Q_i - T)^2 and the conservative term of CQL(H)."""
        with torch.no_grad():
            # (2): T = r + gamma (1 - terminated) min_i Q_target_i(s', a'), a' ~ pi.
            action, _ = sample(self.actor(batch.next_state), noise.target)
            values = [target(batch.next_state, action) for target in self.targets]
            alive = (~batch.terminated).to(action)
            target = batch.reward + self.gamma * alive * torch.min(*values)

            # 3K actions for each s: uniform, from pi(. | s) and from pi(. | s').
            states, next_states = (
                each.repeat_interleave(self.num_random, 0)
                for each in (batch.state, batch.next_state)
            )
            proposals = [
                (noise.uniform, -action.shape[-1] * math.log(2)),
                sample(self.actor(states), noise.current),
                sample(self.actor(next_states), noise.next),
            ]
        td_error, gap = 0.0, 0.0
        for critic in self.critics:
            value = critic(batch.state, batch.action)
            logits = [
                (critic(states, action) - log_prob).view(-1, self.num_random)
                for action, log_prob in proposals
            ]
            soft_maximum = torch.cat(logits, -1).logsumexp(-1)  # ~ log of int exp(Q) da
            td_error = td_error + mse_loss(value, target)
            gap = gap + (soft_maximum - value).mean()
        return {"loss_qvalue": td_error, "loss_cql": self.min_q_weight * gap}

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """Do one gradient step of temperature, actor and critics; move the targets."""
        losses = self.losses(batch, self.draw(batch.action))
        # Critics last: the actor's backward leaves gradients in them.
        for optimizer, loss in (
            (self.alpha_optimizer, losses["loss_alpha"]),
            (self.actor_optimizer, losses["loss_actor"]),
            (self.critic_optimizer, losses["loss_qvalue"] + losses["loss_cql"]),
        ):
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            for critic, target in zip(self.critics, self.targets, strict=True):
                weights = zip(critic.parameters(), target.parameters(), strict=True)
                for source, moved in weights:
                    moved.mul_(1 - self.tau).add_(source, alpha=self.tau)
        return losses


def main() -> None:
    """Train on 1,000 steps of s' = 0.9 s + a, rewarded near the origin."""
    state, action = torch.randn(1000, 3), torch.rand(1000, 3) * 1.8 - 0.9
    next_state, no = 0.9 * state + action, torch.zeros(1000, dtype=torch.bool)
    reward = -next_state.norm(dim=-1)
    perturbed = state + 1e-2 * torch.randn_like(state)
    data = Batch(state, action, reward, next_state, no, no, perturbed)
    osr = PlainOSR(3, 3, [64, 64])
    for step in range(300):
        rows = torch.randint(1000, (64,))
        batch = Batch(*(each[rows] for each in data))
        if step < 200:  # first the model, which is frozen from then on
            osr.model_optimizer.zero_grad()
            osr.inverse_dynamics_loss(batch).backward()
            osr.model_optimizer.step()
        else:
            losses = osr.update(batch)
    print({key: round(value.item(), 3) for key, value in losses.items()})


if __name__ == "__main__":
    main()
