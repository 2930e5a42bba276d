r"""CQL(H) as published: conservative Q-learning with a soft actor-critic.

Shapes: ``R`` rows, ``A`` action, ``N`` critics, ``K`` sampled actions of a kind. The
equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from torchrl_osr import functional as F
from torchrl_osr._checks import check_at_least, check_positive
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses, StatePolicy
from torchrl_osr.objectives.transitions import States, Transitions


class CQLLoss(ActorCriticLoss):
    r"""Conservative Q-learning, CQL(H).

    .. math::
        L_\pi &= \mathbb E_D [\alpha_e \log\pi(\hat a \mid s) - \min_i Q_i(s, \hat a)]
            \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_D \Big[
            \log \sum_{j=1}^{3K} e^{Q_i(s, a_j)} / p(a_j) - Q_i(s, a) \Big]

    "Conservative Q-Learning for Offline Reinforcement Learning", appendix F,
    https://arxiv.org/abs/2006.04779. TorchRL 0.14.1's ``CQLLoss`` differs, see
    :func:`~torchrl_osr.functional.conservative_gap`: before training, ``loss_cql`` here
    is larger by about ``min_q_weight * N * log(K)``. With ``min_q_weight=0,
    deterministic_backup=False`` and ten critics it is SAC-N
    (https://arxiv.org/abs/2110.01548).

    Each entry is weighted already and sends gradient to its own parameters only.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).

    Keyword Args:
        actor_states: where the policy seeks values: ``"clean"`` (default) states,
            ``"perturbed"``, or ``"both"`` for D_tot; these need perturbed entries.
        min_q_weight: :math:`\alpha`, weight of the conservative term. Default 5.0. May
            be assigned later. Pass 0 to remove the term permanently.
        num_random: ``K``, actions a kind: uniform, at ``s``, at ``s'``. Default 10.
        temperature: of the log-sum-exp, :math:`\tau`, in units of the value. Default 1.
        target_action_gap: learn a multiplier of the conservative term that holds the
            gap at this value; adds ``loss_alpha_prime``. Default: none.
        clip_diff_min: lower bound of the gap, per critic and row, in units of the
            value. Default: none.
        max_q_backup: target of the best of ``num_random`` actions. Default ``False``.
        deterministic_backup: leave the entropy out of the target. Default ``True``.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        target_entropy: in nats; ``"auto"`` (default): minus the action's size.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr import CQLLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> loss = CQLLoss(tanh_gaussian_actor(11, 3), critic_ensemble(11, 3))
        >>> [key for key in loss.out_keys if key.startswith("loss_")]
        ['loss_actor', 'loss_alpha', 'loss_qvalue', 'loss_cql']
    """

    _schedulable_buffers = frozenset({"min_q_weight"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        actor_states: States = "clean",
        min_q_weight: float = 5.0,
        num_random: int = 10,
        temperature: float = 1.0,
        target_action_gap: float | None = None,
        clip_diff_min: float = -math.inf,
        max_q_backup: bool = False,
        deterministic_backup: bool = True,
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        check_at_least(1, "num_random", num_random)
        check_positive("temperature", temperature)
        super().__init__(**options)
        self.actor_states: States = actor_states
        self.reads_perturbed = actor_states != "clean"
        networks = actor_network, qvalue_network
        self.register_soft_actor_critic(*networks, alpha_init, target_entropy)
        self.register_coefficient("min_q_weight", min_q_weight)
        self.has_cql = min_q_weight > 0
        self.with_lagrange = target_action_gap is not None
        if self.with_lagrange and not self.has_cql:
            raise ValueError("target_action_gap needs min_q_weight above 0.")
        if self.with_lagrange:
            self.log_alpha_prime = nn.Parameter(self.scalar(0))
        self.num_random, self.temperature = num_random, temperature
        self.target_action_gap, self.clip_diff_min = target_action_gap, clip_diff_min
        self.max_q_backup = max_q_backup
        self.deterministic_backup = deterministic_backup
        self.declare_soft_actor_critic()

    def losses(self, batch: Transitions) -> Losses:
        return self.cql_losses(batch, self.policy(batch))

    def cql_losses(self, batch: Transitions, policy: StatePolicy) -> Losses:
        """Return all losses of CQL(H), weighted, and their metrics."""
        states = self.actor_states
        objective, log_prob = self.soft_policy_objective(batch, policy, states)
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob)
        if self.has_cql:
            q_data, gap = self.conservative_gap(batch, policy)
            if self.target_action_gap is not None:
                gap, multiplier = F.lagrange_terms(
                    gap, self.log_alpha_prime, self.target_action_gap
                )
                reduced = self.reduce(multiplier.mean(0), batch, batch.is_data)
                losses["loss_alpha_prime"] = self.min_q_weight * reduced
                metrics["alpha_prime"] = self.log_alpha_prime.detach().exp()
            # The action of a rollout is the policy's own, and is not to be preferred.
            reduced = self.reduce(gap.sum(0), batch, batch.is_data)
            losses["loss_cql"] = self.min_q_weight * reduced
        else:
            q_data = self.q(batch.s, batch.a)
        error, values = self.td_error(batch, q_data, self.soft_target(batch, policy))
        losses["loss_qvalue"] = self.reduce(error, batch)
        return losses, metrics | values

    def conservative_gap(
        self, batch: Transitions, policy: StatePolicy
    ) -> tuple[Tensor, Tensor]:
        """Return :math:`Q_i(s, a)` and CQL(H)'s gap, ``[N, R]`` each."""
        alike = self.clip_diff_min == -math.inf and self.rows_weigh_alike(batch)
        q_data, soft_maximum = self.critics.values_and_soft_maximum(
            batch.s, batch.a, *self.proposals(batch, policy), alike=alike
        )
        gap = F.conservative_gap(soft_maximum, q_data)
        if self.clip_diff_min > -math.inf:
            gap = gap.clamp(min=self.clip_diff_min)
        return q_data, gap
