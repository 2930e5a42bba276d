"""A policy that looks ahead in a dynamics model where it is far from its data.

Shapes: ``B`` states, ``S`` observation, ``A`` action, ``C`` candidates, ``K`` offsets
of each, ``E`` elites of the model.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torchrl.envs import ObservationNorm

from torchrl_osr._checks import check_positive
from torchrl_osr.imagination.termination import Termination, never
from torchrl_osr.modules.dynamics import DynamicsEnsemble


class LookAheadPolicy:
    r"""Plan with a dynamics model far from the data; elsewhere, act as the policy does.

    .. math::
        a = \pi(s) + \delta_0, \qquad \delta = \arg\max_{\delta_0 \dots \delta_{K-1}}
        \frac1E \sum_{i=1}^{E} \Big( \sum_{t=1}^{H} \text{alive}^i_t
        + \text{alive}^i_H \, V(s^i_H) \Big)

    where each elite :math:`i` is rolled out by itself with its mean prediction,
    :math:`s^i_{t+1} = f_i(s^i_t, \pi(s^i_t) + \delta_{\lfloor t / h \rfloor})`, actions
    are clipped to their bounds, and after :math:`K h` steps the policy goes on alone:
    it is the tail of every plan. The score is the number of steps survived, and the
    value of the last state in the same unit. The cross-entropy method searches the
    offsets. The policy itself (no offsets) is the first candidate, and is kept unless
    another one scores more. Without a value, nothing is searched where the policy
    survives until the horizon in every elite: nothing scores more.

    Such H-step look-ahead is known from "Model-Based Offline Planning" (MBOP,
    https://arxiv.org/abs/2008.05556) and "Learning Off-Policy with Online Planning"
    (LOOP, https://arxiv.org/abs/2008.10066); to plan only where the state is far from
    the data is ours.

    It plans anew at every call, so that it is a function of the state: the candidates'
    noise is drawn once, and neither earlier calls nor the other rows of a batch matter
    (but for torch's rounding).

    Args:
        policy: maps observations ``[B, S]`` to actions ``[B, A]`` in [-1, 1], without
            randomness of its own; :class:`~torchrl_osr.Policy` for instance.
        model: of the dynamics, such as
            :func:`~torchrl_osr.experiment.dynamics.load_dynamics` loads.
        far: which of the observations ``[B, S]`` it plans for, bool ``[B]``:
            ``lambda state: distance(state) > distance.threshold`` with a
            :class:`~torchrl_osr.evaluation.DataDistance`.

    Keyword Args:
        terminated: of next observations; what has ended there does not survive. Default
            :func:`~torchrl_osr.imagination.never`; see
            :func:`~torchrl_osr.imagination.termination` for the rules of tasks.
        value: of observations ``[n, S]``, in steps, ``[n]``. Default: 0, survival until
            the horizon alone.
        observation_norm: how the model's data were standardised
            (``standard_normal=True``). Default: not at all.
        planning_horizon: ``H``, steps. Default 40.
        num_offsets: ``K``. Default 5.
        hold: ``h``, steps for which an offset is added. Default 4.
        num_candidates: ``C``. Default 64.
        top_k: candidates from which the next ones are drawn. Default 8.
        optim_steps: how often candidates are drawn. Default 3.
        std: of the first offsets. Default 0.5.
        generator: draws the candidates' noise. Default: one with seed 0.

    Raises:
        ValueError: a number is out of its range, or offsets last beyond the horizon.

    Examples:
        >>> import torch
        >>> from torchrl_osr.imagination import LookAheadPolicy, termination
        >>> from torchrl_osr.modules import DynamicsEnsemble
        >>> def policy(state):
        ...     return torch.zeros(len(state), 3)
        >>> look_ahead = LookAheadPolicy(
        ...     policy, DynamicsEnsemble(11, 3), far=lambda state: state[:, 1] > 0.1,
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
        model: DynamicsEnsemble,
        far: Callable[[Tensor], Tensor],
        *,
        terminated: Termination = never,
        value: Callable[[Tensor], Tensor] | None = None,
        observation_norm: ObservationNorm | None = None,
        planning_horizon: int = 40,
        num_offsets: int = 5,
        hold: int = 4,
        num_candidates: int = 64,
        top_k: int = 8,
        optim_steps: int = 3,
        std: float = 0.5,
        generator: torch.Generator | None = None,
    ) -> None:
        for name, number in (
            ("num_offsets", num_offsets), ("hold", hold), ("optim_steps", optim_steps),
        ):  # fmt: skip
            check_positive(name, number, minimum=1)
        check_positive("std", std)
        if planning_horizon < num_offsets * hold:
            raise ValueError(
                f"planning_horizon={planning_horizon} is shorter than the "
                f"{num_offsets} offsets of {hold} steps each; expected at least "
                f"{num_offsets * hold}."
            )
        if not 1 <= top_k < num_candidates:
            raise ValueError(
                f"top_k must be between 1 and num_candidates - 1 = "
                f"{num_candidates - 1}, got {top_k}."
            )
        self.policy, self.far, self.terminated = policy, far, terminated
        self.value, self.norm = value, observation_norm
        self.model = model.elite_networks()
        self.planning_horizon, self.hold = planning_horizon, hold
        self.top_k, self.std = top_k, std
        generator = generator or torch.Generator().manual_seed(0)
        shape = optim_steps, num_candidates, num_offsets, model.action_dim
        # TorchRL's CEMPlanner plans all actions from nothing: it has no policy to start
        # from and to go on with, no value of the last state, and torch's global
        # generator; and it returns the elite's mean, which nobody has tried.
        self.noise = torch.randn(
            shape, generator=generator, device=generator.device
        ).to(model.target_loc.device)

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
        networks, batch = self.model.num_networks, offsets.shape[:2]
        offsets = offsets.flatten(0, 1).repeat_interleave(self.hold, 1)
        starts = observation.repeat_interleave(batch[1], 0).expand(networks, -1, -1)
        state, steps = starts, starts.new_zeros(starts.shape[:-1])
        alive = torch.ones_like(steps, dtype=torch.bool)
        for step in range(self.planning_horizon):
            action = self._of_all(self.policy, state)
            if step < offsets.shape[1]:
                action = (action + offsets[:, step]).clamp(-1, 1)
            state = self._following(state, action)
            alive &= state.isfinite().all(-1) & ~self.terminated(state)
            if not alive.any():
                break
            # What has fallen must not grow until it overflows.
            state = torch.where(alive.unsqueeze(-1), state, starts)
            steps = steps + alive
        if self.value is not None:
            steps = steps + alive * self._of_all(self.value, state)
        return steps.mean(0).view(batch)

    def _of_all(self, function: Callable[[Tensor], Tensor], state: Tensor) -> Tensor:
        """A function of rows, of the states ``[E, n, S]`` of all networks."""
        value = function(state.flatten(0, 1))
        return value.reshape(*state.shape[:2], *value.shape[1:])

    def _following(self, state: Tensor, action: Tensor) -> Tensor:
        """Each network's mean prediction for its own states, ``[E, n, S]``."""
        loc, scale = 0.0, 1.0
        if self.norm is not None:
            loc, scale = self.norm.loc, self.norm.scale
        inputs = torch.cat([(state - loc) / scale, action], -1)
        mean, _ = self.model.standardized(inputs)
        change = mean * self.model.target_scale + self.model.target_loc
        following: Tensor = state + change[..., :-1] * scale
        return following
