r"""OSR-v: critics that prefer the actions which lead back to the data.

Shapes: ``R`` rows, ``A`` action, ``N`` critics, ``K`` sampled actions of a kind. The
equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional as F
from torchrl_osr._checks import check_at_least, check_choice, check_positive
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses, StatePolicy
from torchrl_osr.objectives.networks import check_num_actions
from torchrl_osr.objectives.transitions import SETS, States, Transitions


class OSRVLoss(ActorCriticLoss):
    r"""Out-of-sample State Recovery by a constraint on the values (OSR-v).

    .. math::
        L_\pi &= \mathbb E_{\tilde s \sim D_{tot}}
            [\alpha_e \log\pi(\hat a \mid \tilde s) - \min_i Q_i(\tilde s, \hat a)] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_{D_{tot}} \Big[
            \mathbb E_{\hat a \sim \pi(\tilde s)} Q_i(\tilde s, \hat a)
            - \mathbb E_{a \sim I(\tilde s, s')} Q_i(\tilde s, a) \Big]

    "Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
    Learning", section 4.3, https://openreview.net/forum?id=4gLWjSaw4o. The constraint
    replaces CQL's: with the defaults the critics score 16 actions a row instead of 68.
    Off the data the constraint may be negative, so it gives no lower bound as CQL does.

    ``loss_qvalue`` holds both terms of :math:`L_Q`.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic or a list, see :class:`~torchrl_osr.CQLLoss`.
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds, frozen here. Not needed with ``recovery_target="data"``.

    Keyword Args:
        recovery_weight: :math:`\alpha`, weight of the constraint. Default 5.0. May be
            assigned later.
        recovery_target: whose actions the policy's are compared with:
            ``"inverse_dynamics"`` (default), the model's, or ``"data"``, the data's
            own, at clean and at perturbed states: OSR-v without its model.
        policy_values: how the first expectation is taken. ``"mean"`` (default) is the
            paper's, over ``K`` actions of the policy. ``"cql"`` takes CQL(H)'s samples,
            as the authors' code does for (3): ``K`` uniform actions, ``K`` at the state
            and ``K`` at ``s'``. It compares them with the data's action at clean
            states, and with one of the model's at perturbed states. At clean states it
            is CQL(H)'s term.
        num_random: ``K``, actions drawn of each kind. Default 1.
        temperature: of the log-sum-exp. Default 1.0.
        alpha_init, target_entropy: see :class:`~torchrl_osr.CQLLoss`.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr import OSRVLoss
        >>> from torchrl_osr.modules import (
        ...     critic_ensemble, tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> loss = OSRVLoss(tanh_gaussian_actor(11, 3), critic_ensemble(11, 3),
        ...                 tanh_gaussian_inverse_dynamics(11, 3))
        >>> [key for key in loss.out_keys if key.startswith("loss_")]
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"recovery_weight"})
    reads_perturbed = deterministic_backup = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 5.0,
        recovery_target: Literal["inverse_dynamics", "data"] = "inverse_dynamics",
        policy_values: Literal["mean", "cql"] = "mean",
        num_random: int = 1,
        temperature: float = 1.0,
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        check_at_least(1, "num_random", num_random)
        check_positive("temperature", temperature)
        check_choice("policy_values", policy_values, ("mean", "cql"))
        check_choice("recovery_target", recovery_target, ("inverse_dynamics", "data"))
        if recovery_target != "data" and inverse_dynamics_network is None:
            raise ValueError(
                "OSRVLoss needs an inverse_dynamics_network: pass one, or "
                "recovery_target='data' for the data's own actions."
            )
        super().__init__(**options)
        networks = actor_network, qvalue_network
        self.register_soft_actor_critic(*networks, alpha_init, target_entropy)
        if recovery_target != "data" and inverse_dynamics_network is not None:
            self.register_model(inverse_dynamics_network)
        self.register_coefficient("recovery_weight", recovery_weight)
        self.recovery_target, self.policy_values = recovery_target, policy_values
        self.num_random, self.temperature = num_random, temperature
        self.declare_soft_actor_critic("recovery_gap")

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        objective, log_prob = self.soft_policy_objective(batch, policy, "both")
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob)
        q_data, gap = self.data_values_and_gap(batch, policy)
        # The paper prints OSR-v's TD error without the square; (2) has it.
        error, values = self.td_error(batch, q_data, self.soft_target(batch, policy))
        valid = batch.is_data if self.policy_values == "cql" else batch.has_next
        constraint = self.reduce(gap, batch, valid)
        qvalue = self.reduce(error, batch) + self.recovery_weight * constraint
        metrics["recovery_gap"] = self.mean(gap, batch, valid)
        return losses | {"loss_qvalue": qvalue}, metrics | values

    def data_values_and_gap(
        self, batch: Transitions, policy: StatePolicy
    ) -> tuple[Tensor, Tensor]:
        """Return :math:`Q_i(s, a)`, ``[N, R]``, and the gap of (8), ``[R]``.

        The gap is the mean over both halves of D_tot, summed over critics.
        """
        if self.policy_values == "cql":
            return self.data_values_and_cql_gap(batch, policy)
        with torch.no_grad():
            action, _ = rsample_and_log_prob(policy["both"], (self.num_random,))
        target = self.recovery_actions(batch, "both", self.num_random)
        candidates = torch.cat([action, target])
        mixed = batch.states[SETS["both"]].expand(candidates.shape[:-1])
        # One pass of the critics for the data's action and all candidates.
        qvalue = self.q(
            torch.cat([batch.states[SETS["clean"]], mixed.flatten(0, 1)]),
            torch.cat([batch.a.unsqueeze(0), candidates.flatten(0, 1)]),
        )
        compared = qvalue[:, 1:].reshape(-1, *candidates.shape[:-1]).movedim(1, -1)
        gap = F.value_constraint(*compared.tensor_split([len(action)], -1))
        return qvalue[:, 0], gap.mean(1).sum(0)

    def data_values_and_cql_gap(
        self, batch: Transitions, policy: StatePolicy
    ) -> tuple[Tensor, Tensor]:
        """Return the same, with CQL(H)'s term at clean and at perturbed states."""
        # The paper prints (8), like (3), with a mean over pi(s~). For (3) the authors'
        # code takes a log-sum-exp, also over uniform actions and those of pi(s').
        sets = "recorded", "perturbed_and_next"
        drawn = [self.proposals(batch, policy, states) for states in sets]
        sampled = (torch.cat(both, 1) for both in zip(*drawn, strict=True))
        # (8) has the model's action at clean states, too. In expectation it is the
        # data's (Proposition 2), used here; rows without s' have the data's at both.
        wanted = self.recovery_actions(batch, "perturbed", 1)[0, 0]
        wanted = torch.where(batch.has_next.unsqueeze(-1), wanted, batch.a)
        mixed = batch.states[SETS["both"]].reshape(-1)
        target, alike = torch.cat([batch.a, wanted]), self.rows_weigh_alike(batch)
        qvalue, soft_maximum = self.critics.values_and_soft_maximum(
            mixed, target, *sampled, alike=alike
        )
        gap = F.conservative_gap(soft_maximum, qvalue).reshape(len(qvalue), 2, -1)
        return qvalue[:, : len(batch.a)], gap.mean(1).sum(0)

    @torch.no_grad()
    def recovery_actions(
        self, batch: Transitions, states: States, number: int
    ) -> Tensor:
        """Return actions to recover with, ``[K, D, R, A]``; the data's: ``K = 1``."""
        if self.recovery_target == "data":
            return batch.a.expand(1, 1 + (states == "both"), *batch.a.shape)
        model = self.inverse_dynamics(batch, states)
        check_num_actions("inverse_dynamics_network", model.loc, batch.a)
        return rsample_and_log_prob(model, (number,))[0]
