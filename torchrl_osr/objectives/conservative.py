"""What keeps the critics from overrating actions: CQL's term, EDAC's diversity.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``K``
sampled actions of a kind. The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives.utils import _vmap_func

from torchrl_osr import functional
from torchrl_osr._checks import check_weight
from torchrl_osr.objectives import mlp_critics
from torchrl_osr.objectives.mlp_layers import PlainMLP
from torchrl_osr.objectives.tanh_gaussian import TanhGaussianActorCritic


class ConservativeCritics(TanhGaussianActorCritic):
    """Abstract base of :class:`~torchrl_osr.OSRLoss`, which documents the options."""

    def __init__(
        self,
        *networks: Any,
        min_q_weight: float,
        importance_sample: bool,
        clip_diff: tuple[float, float],
        max_q_backup: bool,
        deterministic_backup: bool,
        with_lagrange: bool,
        lagrange_thresh: float,
        diversity_weight: float,
        chunk_size: int | None,
        **options: Any,
    ) -> None:
        check_weight("min_q_weight", min_q_weight)
        check_weight("diversity_weight", diversity_weight)
        if with_lagrange and not min_q_weight:
            raise ValueError("with_lagrange=True needs min_q_weight above 0.")
        if not clip_diff[0] < clip_diff[1]:
            raise ValueError(
                "clip_diff_min must be below clip_diff_max, got "
                f"{clip_diff[0]} and {clip_diff[1]}."
            )
        if chunk_size is not None and chunk_size < 1:
            raise ValueError(
                f"chunk_size must be at least 1 or None, got {chunk_size}."
            )
        super().__init__(*networks, **options)
        self.chunk_size = chunk_size
        if diversity_weight and self.num_qvalue_nets < 2:
            raise ValueError(
                f"diversity_weight={diversity_weight} compares critics with each "
                "other: it needs num_qvalue_nets of at least 2."
            )
        self.register_coeff_buffer("min_q_weight", float(min_q_weight))
        self.register_coeff_buffer("diversity_weight", float(diversity_weight))
        self.conserves = min_q_weight > 0
        self.diversifies = diversity_weight > 0
        self.importance_sample = importance_sample
        self.clip_diff = clip_diff
        self.max_q_backup = max_q_backup
        self.deterministic_backup = deterministic_backup
        self.with_lagrange = with_lagrange
        self.lagrange_thresh = lagrange_thresh
        if with_lagrange:
            self.log_alpha_prime = torch.nn.Parameter(torch.zeros(()))

    def _make_vmap(self) -> None:
        super()._make_vmap()
        self._vmap_qvalue_each = _vmap_func(
            self.qvalue_network,
            (0, 0),
            randomness=self.vmap_randomness,
            pseudo_vmap=self.deactivate_vmap,
        )

    def _critic_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        """Return the losses of this file and its metrics, in their order."""
        losses = ["loss_cql"] * self.conserves + ["loss_diversity"] * self.diversifies
        losses += ["loss_alpha_prime"] * self.with_lagrange
        return losses, ["alpha_prime"] * self.with_lagrange

    @torch.no_grad()
    def _next_value(self, states: TensorDictBase, pi: TanhNormal) -> Tensor:
        number = (self.num_random,) if self.max_q_backup else ()
        action, log_prob = rsample_and_log_prob(pi, number)
        params = self.target_qvalue_network_params
        states = states.expand(action.shape[:-1])
        value: Tensor = self._qvalue(states, action, params).min(0).values
        if self.max_q_backup:
            value, best = value.max(0)
            log_prob = log_prob.gather(0, best.unsqueeze(0)).squeeze(0)
        if not self.deterministic_backup:
            value = value - self.log_alpha.exp() * log_prob
        return value

    @torch.no_grad()
    def _proposals(self, policy: TensorDictBase, like: Tensor) -> tuple[Tensor, Tensor]:
        """Draw K actions each: uniform, from pi(s) and from pi(s').

        Args:
            policy: the policy at ``s`` and ``s'``, ``[2, B]``.
            like: an action, ``[B, A]``.

        Returns:
            Actions ``[3K, B, A]`` and their log-densities ``[3K, B]``.
        """
        uniform, log_density = self._uniform(self.num_random, like)
        # rsample also without gradient: torch's sample reads the scale back to the host
        # to check its sign.
        action, log_prob = rsample_and_log_prob(
            self._distribution(policy), (self.num_random,)
        )
        return (
            torch.cat([uniform, action.flatten(0, 1)]),
            torch.cat([log_density, log_prob.flatten(0, 1)]),
        )

    def _critic_terms(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        data_action: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Return the values of the data's actions ``[N, B]``, losses and metrics."""
        losses: dict[str, Tensor] = {}
        duals: dict[str, Tensor] = {}
        metrics: dict[str, Tensor] = {}
        if self.conserves:
            pred_value, gap = self._conservative_gap(states, policy, data_action)
            if self.with_lagrange:
                gap, dual = functional.lagrange_terms(
                    gap, self.log_alpha_prime, self.lagrange_thresh
                )
                dual = self._reduce(dual.mean(0), tensordict)
                duals["loss_alpha_prime"] = self.min_q_weight * dual
                metrics["alpha_prime"] = self.log_alpha_prime.detach().exp()
            gap = self._reduce(gap.sum(0), tensordict)
            losses["loss_cql"] = self.min_q_weight * gap
        else:
            params = self.qvalue_network_params
            pred_value = self._qvalue(states[0], data_action, params)
        if self.diversifies:
            gradients = self._action_gradients(states[0], data_action)
            diversity = functional.gradient_diversity(gradients)
            diversity = self._reduce(diversity, tensordict)
            losses["loss_diversity"] = self.diversity_weight * diversity
        return pred_value, losses | duals, metrics

    def _conservative_gap(
        self, states: TensorDictBase, policy: TensorDictBase, data_action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the values of the data's actions and CQL's gap, each ``[N, B]``."""
        action, log_prob = self._proposals(policy[:2].detach(), data_action)
        params = self.qvalue_network_params
        if self._takes_the_fast_path(states[0], data_action):
            pred_value = self._qvalue(states[0], data_action, params)
            gap = self._fast_soft_maximum(states[0], action, log_prob, data_action)
            gap = gap - pred_value
        else:
            # One pass of the critics for the data's action and all proposals.
            action = torch.cat([data_action.unsqueeze(0), action])
            clean = states[0].expand(action.shape[:-1])
            qvalue = self._qvalue(clean, action, params)
            pred_value, sampled = qvalue[:, 0], qvalue[:, 1:].movedim(1, -1)
            gap = functional.conservative_gap(
                sampled,
                log_prob.movedim(0, -1) if self.importance_sample else None,
                pred_value,
                temperature=self.temperature,
            )
        if self.clip_diff != (-math.inf, math.inf):
            gap = gap.clamp(*self.clip_diff)
        return pred_value, gap

    def _takes_the_fast_path(self, state: TensorDictBase, action: Tensor) -> bool:
        """Return whether plain MLP critics shall be run chunk by chunk, on a CPU."""
        return (
            self.chunk_size is not None
            and self._plain_critics() is not None
            and action.device.type == "cpu"
            and torch.is_grad_enabled()
            and not torch.compiler.is_compiling()
            and not any(value.requires_grad for value in state.values(True, True))
        )

    def _fast_soft_maximum(
        self,
        state: TensorDictBase,
        action: Tensor,
        log_prob: Tensor,
        data_action: Tensor,
    ) -> Tensor:
        """Return the log-sum-exp of the conservative gap, ``[N, B]``."""
        if not self.importance_sample:
            action = torch.cat([action, data_action.unsqueeze(0)])
        value = mlp_critics.soft_maximum(
            self.qvalue_network_params,
            cast(PlainMLP, self._plain_critics()),
            self._critic_state(state).flatten(0, -2),
            action.flatten(1, -2),
            log_prob.flatten(1) if self.importance_sample else None,
            temperature=self.temperature,
            chunk_size=cast(int, self.chunk_size),
        )
        return value.reshape(-1, *data_action.shape[:-1])

    def _action_gradients(self, state: TensorDictBase, action: Tensor) -> Tensor:
        """Return the gradient of each critic by the action, ``[N, B, A]``."""
        number = self.num_qvalue_nets
        states = self._critic_inputs(state).expand(number, *state.batch_size)
        params = self.qvalue_network_params

        def total(action: Tensor) -> Tensor:
            batch = states.copy().set(self.tensor_keys.action, action)
            batch = self._vmap_qvalue_each(batch, params)
            value: Tensor = batch.get(self.tensor_keys.state_action_value)
            return value.sum()

        # torch.func, unlike torch.autograd.grad, can be compiled; both can be
        # differentiated once more.
        gradient: Tensor = torch.func.grad(total)(action.expand(number, *action.shape))
        return gradient
