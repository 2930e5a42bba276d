"""A policy that looks ahead in a dynamics model where it is far from its data.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``C`` candidates, ``K`` offsets
of each, ``E`` elites of the model.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_osr._checks import check_positive
from torchrl_osr.imagination.rollout import expect
from torchrl_osr.imagination.termination import Termination, never
from torchrl_osr.modules.elite_networks import EliteNetworks


class LookAheadPolicy:
    r"""Plan with a dynamics model far from the data; elsewhere, act as the policy does.

    .. math::
        a = \pi(s) + \delta_0, \qquad \delta = \arg\max_{\delta_0 \dots \delta_{K-1}}
        \frac1E \sum_{i=1}^{E} \Big( \sum_{t=1}^{H} \text{alive}^i_t
        + \text{alive}^i_H \, V(s^i_H) \Big)

    the steps survived, and the value of the last state. Each elite :math:`i` is rolled
    out by itself with its mean prediction, :math:`s^i_{t+1} = f_i(s^i_t, \pi(s^i_t) +
    \delta_{\lfloor t / h \rfloor})`; after :math:`K h` steps the policy goes on alone.
    The cross-entropy method searches the offsets. No offsets are the first candidate,
    kept unless another one scores more; without a value nothing is searched where the
    policy survives in every elite.

    Such H-step look-ahead is known from "Model-Based Offline Planning" (MBOP,
    https://arxiv.org/abs/2008.05556) and "Learning Off-Policy with Online Planning"
    (LOOP, https://arxiv.org/abs/2008.10066); to plan only far from the data is ours.

    It plans anew at every call, and the candidates' noise is drawn once: it is a
    function of the state, whatever came before and whatever else is in the batch.

    Args:
        policy: maps observations ``[B, S]`` to actions ``[B, A]`` in [-1, 1], without
            randomness of its own; :class:`~torchrl_osr.Policy` for instance.
        networks: of the dynamics, in the policy's units.
        far: which of the observations ``[B, S]`` it plans for, bool ``[B]``:
            ``lambda state: distance(state) > distance.threshold`` with a
            :class:`~torchrl_osr.evaluation.DataDistance`.

    Keyword Args:
        terminated: of next observations, see
            :func:`~torchrl_osr.imagination.termination`. Default: never.
        value: of observations ``[n, S]``, in steps, ``[n]``. Default: 0.
        planning_horizon: ``H``, steps. Default 40.
        num_offsets, hold: ``K``, and for how many steps each is added. Default 5 and 4.
        num_candidates, top_k: ``C``, and how many of them the next ones are drawn
            around. Default 64 and 8.
        optim_steps: how often candidates are drawn. Default 3.
        std: of the first offsets. Default 0.5.
        generator: draws the candidates' noise. Default: one with seed 0.

    Raises:
        ValueError: a number is out of its range, or offsets last beyond the horizon.

    Examples:
        >>> import torch
        >>> from torchrl_osr.imagination import LookAheadPolicy, termination
        >>> from torchrl_osr.modules import DynamicsEnsemble, EliteNetworks
        >>> look_ahead = LookAheadPolicy(
        ...     lambda state: torch.zeros(len(state), 3),
        ...     EliteNetworks(DynamicsEnsemble(11, 3)),
        ...     far=lambda state: state[:, 1] > 0.1,
        ...     terminated=termination("Hopper-v5"), planning_horizon=20)
        >>> state = torch.zeros(2, 11)
        >>> state[:, 0], state[1, 1] = 1.2, 0.15
        >>> action = look_ahead(state)
        >>> action.shape, bool((action[0] == 0).all())
        (torch.Size([2, 3]), True)
    """

    def __init__(
        self,
        policy: Callable[[Tensor], Tensor],
        networks: EliteNetworks,
        far: Callable[[Tensor], Tensor],
        *,
        terminated: Termination = never,
        value: Callable[[Tensor], Tensor] | None = None,
        planning_horizon: int = 40,
        num_offsets: int = 5,
        hold: int = 4,
        num_candidates: int = 64,
        top_k: int = 8,
        optim_steps: int = 3,
        std: float = 0.5,
        generator: torch.Generator | None = None,
    ) -> None:
        check_positive("num_offsets", num_offsets, minimum=1)
        check_positive("hold", hold, minimum=1)
        check_positive("optim_steps", optim_steps, minimum=1)
        check_positive("std", std)
        check_positive("planning_horizon", planning_horizon, minimum=num_offsets * hold)
        if not 1 <= top_k < num_candidates:
            raise ValueError(
                f"top_k must be between 1 and num_candidates - 1 = "
                f"{num_candidates - 1}, got {top_k}."
            )
        self.policy, self.far, self.terminated = policy, far, terminated
        self.value = value
        self.networks = networks
        self.planning_horizon, self.hold = planning_horizon, hold
        self.top_k, self.std = top_k, std
        generator = generator or torch.Generator().manual_seed(0)
        shape = optim_steps, num_candidates, num_offsets, networks.action_dim
        # TorchRL's CEMPlanner has no policy to plan around and to go on with, no value
        # of the last state, torch's global generator, and returns an untried mean.
        noise = torch.randn(shape, generator=generator, device=generator.device)
        self.noise = noise.to(networks.biases[0].device)

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Actions ``[B, A]`` for observations ``[B, S]``."""
        action = self.policy(observation)
        far = self.far(observation).to(observation.device)
        if far.any():
            offset = self.plan(observation[far])[:, 0]
            action = action.clone()
            action[far] = (action[far] + offset).clamp(-1, 1)
        return action

    @torch.no_grad()
    def plan(self, observation: Tensor) -> Tensor:
        """The best offsets ``[B, K, A]`` that were found for each of ``[B, S]``."""
        nothing = self.noise.new_zeros(len(observation), *self.noise.shape[2:])
        if self.value is not None:
            return self._search(observation, nothing)
        alone = self.scores(observation, nothing.unsqueeze(1)).squeeze(1)
        falls = alone < self.planning_horizon
        if falls.any():
            nothing[falls] = self._search(observation[falls], nothing[falls])
        return nothing

    def _search(self, observation: Tensor, mean: Tensor) -> Tensor:
        """Cross-entropy method around offsets ``[B, K, A]``."""
        rows = torch.arange(len(observation), device=observation.device)
        std = torch.full_like(mean, self.std)
        best, highest = mean, mean.new_full(rows.shape, -torch.inf)
        for noise in self.noise:
            offsets = mean.unsqueeze(1) + std.unsqueeze(1) * noise
            offsets = offsets.clamp(-2, 2)  # from one bound of an action to the other
            offsets[:, 0] = mean  # at first: the policy itself
            scores = self.scores(observation, offsets)
            order = scores.argsort(dim=1, descending=True, stable=True)
            first = order[:, 0]
            better = scores[rows, first] > highest
            highest = torch.where(better, scores[rows, first], highest)
            best = torch.where(better[:, None, None], offsets[rows, first], best)
            elite = offsets[rows.unsqueeze(1), order[:, : self.top_k]]
            mean, std = elite.mean(1), elite.std(1, correction=0)
        return best

    def scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        """What the model expects of offsets ``[B, C, K, A]``, in steps, ``[B, C]``."""
        return self.elite_scores(observation, offsets).mean(0)

    def elite_scores(self, observation: Tensor, offsets: Tensor) -> Tensor:
        """What each elite expects of them, ``[E, B, C]``."""
        batch = offsets.shape[:2]
        offsets = offsets.flatten(0, 1).repeat_interleave(self.hold, 1)
        offsets = offsets.repeat(self.networks.num_networks, 1, 1)

        def act(state: Tensor, step: int) -> Tensor:
            action = self.policy(state)
            if step < offsets.shape[1]:
                action = (action + offsets[:, step]).clamp(-1, 1)
            return action

        way = expect(
            self.networks,
            act,
            observation.repeat_interleave(batch[1], 0),
            steps=self.planning_horizon,
            terminated=self.terminated,
        )
        steps = way.alive.sum(0).to(way.state.dtype)
        if self.value is not None:
            steps = steps + self.value(way.state).where(way.alive[-1], 0.0)
        return steps.view(-1, *batch)
