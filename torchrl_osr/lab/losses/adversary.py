r"""Perturbed states that an adversary chooses, with the networks at hand.

The attacks are those of "RORL: Robust Offline Reinforcement Learning via Conservative
Smoothing" (Yang et al., NeurIPS 2022), https://arxiv.org/abs/2206.02829

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``M``
candidate perturbations of one state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.modules import TanhNormal

from torchrl_osr._checks import check_choice, check_positive, check_weight
from torchrl_osr._entries import entry, nested
from torchrl_osr.lab.losses.ensembles import jeffreys_divergence
from torchrl_osr.objectives.actor_critic import ActorCriticLoss
from torchrl_osr.objectives.networks import distribution

TanhNormalPolicy = Callable[[TensorDictBase], TanhNormal]
"""Maps states ``[M, B]`` (or ``[B]``) to the policy's distribution there."""

Values = Callable[[TensorDictBase, Tensor], Tensor]
"""Maps states ``[M, B]`` and actions ``[M, B, A]`` to all critics' ``[N, M, B]``."""


@dataclass(frozen=True)
class Adversary:
    r"""Find the perturbation of each state within a box that maximises an objective.

    The box is :math:`|\delta_i| \le \epsilon` for each number of an observation. The
    objectives, with :math:`\hat s = s + \delta`:

    * ``"action_diff"``: :math:`KL(\pi(s) \| \pi(\hat s)) + KL(\pi(\hat s) \| \pi(s))`;
    * ``"min_Q"``: :math:`-\frac1N \sum_i Q_i(s, \pi(\hat s))` with the deterministic
      action. The critics see the true state, from which the misled action is taken.

    The methods:

    * ``"sample"`` (RORL's zero order): the best of ``num_samples`` uniform draws, for
      ``"min_Q"`` also of no perturbation.
    * ``"gradient"``: ``num_steps`` steps of ``step_size * epsilon`` along the sign of
      the gradient, from each of ``num_samples`` draws and within the box. The best end
      counts. One start is RORL's first order, 20 are its mixed order.

    Each row draws for itself; RORL's code draws once for the whole batch. ``epsilon``
    is in units of the observation.

    Examples:
        >>> adversary = Adversary("min_Q", method="gradient", epsilon=0.1)
    """

    objective: Literal["action_diff", "min_Q"] = "action_diff"
    method: Literal["sample", "gradient"] = "sample"
    epsilon: float = 0.01
    num_samples: int = 20
    num_steps: int = 10
    step_size: float = 0.1

    def __post_init__(self) -> None:
        check_choice("objective", self.objective, ("action_diff", "min_Q"))
        check_choice("method", self.method, ("sample", "gradient"))
        check_weight("epsilon", self.epsilon)
        check_positive("num_samples", self.num_samples, minimum=1)

    def __call__(
        self, loss: ActorCriticLoss, tensordict: TensorDictBase
    ) -> TensorDictBase:
        """Return a batch whose perturbed states are the worst for a loss's networks.

        In place of :class:`~torchrl_osr.StatePerturbation`: in a plain loop
        ``loss(adversary(loss, buffer.sample()))``.
        """
        keys = loss.observation_keys
        critics = loss.qvalue_network_params.detach()

        def policy(states: TensorDictBase) -> TanhNormal:
            return distribution(loss.actor_network, loss.actor_network_params, states)

        def qvalue(states: TensorDictBase, action: Tensor) -> Tensor:
            return loss.q(states, action, critics)

        worst = self.perturb(tensordict.select(*keys), keys, policy, qvalue)
        tensordict = tensordict.copy()
        for key in keys:
            tensordict.set(nested(loss.tensor_keys.perturbed, key), worst.get(key))
        return tensordict

    @torch.no_grad()
    def perturb(
        self,
        states: TensorDictBase,
        keys: Sequence[NestedKey],
        policy: TanhNormalPolicy,
        qvalue: Values,
        generator: torch.Generator | None = None,
    ) -> TensorDictBase:
        """Return ``states`` with the entries ``keys`` perturbed, without gradient.

        Only ``"min_Q"`` calls ``qvalue``.
        """
        states = states.detach()
        noise = tuple(self._draw(entry(states, key), generator) for key in keys)
        clean = policy(states.copy()) if self.objective == "action_diff" else None

        def objective(noise: tuple[Tensor, ...]) -> Tensor:
            """Return ``[M, B]`` of perturbations."""
            candidates = states.expand(len(noise[0]), *states.batch_size)
            perturbed = candidates.copy()
            for key, delta in zip(keys, noise, strict=True):
                perturbed.set(key, candidates.get(key) + delta)
            pi = policy(perturbed)
            if clean is None:
                return -qvalue(candidates, pi.deterministic_sample).mean(0)
            return jeffreys_divergence(clean.loc, clean.scale, pi.loc, pi.scale)

        if self.method == "gradient":
            # Unlike torch.autograd.grad, torch.compile can trace it, and no_grad does
            # not switch it off: no parameter enters a graph.
            gradient = torch.func.grad(lambda noise: objective(noise).sum())
            step = self.step_size * self.epsilon
            for _ in range(self.num_steps):
                noise = tuple(
                    (delta + step * slope.sign()).clamp(-self.epsilon, self.epsilon)
                    for delta, slope in zip(noise, gradient(noise), strict=True)
                )
        best, worst = objective(noise).argmax(0, keepdim=True), states.copy()
        for key, candidates in zip(keys, noise, strict=True):
            index = best.reshape(best.shape + (1,) * (candidates.ndim - best.ndim))
            chosen = candidates.take_along_dim(index, 0).squeeze(0)
            worst.set(key, states.get(key) + chosen)
        return worst

    def _draw(self, state: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return candidates for one observation, ``[M, B, ...]``."""
        uniform = state.new_empty((self.num_samples, *state.shape))
        uniform.uniform_(generator=generator)
        noise = self.epsilon * (2 * uniform - 1)
        if self.objective == "min_Q" and self.method == "sample":
            noise = torch.cat([torch.zeros_like(noise[:1]), noise])
        return noise
