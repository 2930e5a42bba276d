r"""OSR: conservative Q-learning whose policy learns to come back to the data.

Shapes: ``R`` rows, ``A`` action, ``N`` critics, ``K`` sampled actions of a kind. The
equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from torchrl_osr import functional as F
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses, StatePolicy
from torchrl_osr.objectives.networks import check_num_actions
from torchrl_osr.objectives.transitions import Transitions


class OSRLoss(ActorCriticLoss):
    r"""Out-of-sample State Recovery by a constraint on the policy (OSR).

    .. math::
        L_\pi &= \mathbb E_{\tilde s \sim D_{tot}}
            [\alpha_e \log\pi(\hat a \mid \tilde s) - \min_i Q_i(\tilde s, \hat a)]
            + \lambda\, \mathbb E_{D_{tot}}
            KL(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s)) \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_D \Big[
            \log \sum_{j=1}^{3K} e^{Q_i(s, a_j)} / p(a_j) - Q_i(s, a) \Big]

    "Recovering from Out-of-sample States via Inverse Dynamics in Offline Reinforcement
    Learning", https://openreview.net/forum?id=4gLWjSaw4o. With ``min_q_weight=0`` and
    ten critics it is OSR-10.

    The entries are those of :class:`~torchrl.objectives.CQLLoss` without warm-up:
    ``loss_actor`` (both terms of :math:`L_\pi`), ``loss_qvalue``, ``loss_cql`` and
    ``loss_alpha``. Each is weighted already and sends gradient to its own parameters
    only: add them up for one backward and one optimizer step, or use separate
    optimizers.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.TanhNormal`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`). It is frozen
            here: in the state dict, moved by ``.to()``, without gradient.

    Keyword Args:
        recovery_weight: :math:`\lambda`. Default 0.5. May be assigned later.
        min_q_weight: :math:`\alpha`, weight of the conservative term. Default 5.0. May
            be assigned later; 0 *here* leaves the term out.
        num_random: ``K``, actions drawn of each kind (uniform, at ``s``, at ``s'``).
            Default 10.
        temperature: :math:`\tau` of the log-sum-exp, in units of the value. Default
            1.0.
        target_action_gap: learn a multiplier of the conservative term that holds the
            gap at this value; adds ``loss_alpha_prime``. Default: none.
        clip_diff_min: lower bound of the gap, per critic and row, in units of the
            value. Default: none.
        max_q_backup: the target takes the best of ``num_random`` actions. Default
            ``False``.
        deterministic_backup: leave the entropy out of the target, as CQL does and
            SAC-N does not. Default ``True``.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is minus the action's size.
        delay_actor: the action in the TD target is that of a target actor. Default
            ``False``.
        options: of every loss, see
            :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Raises:
        TypeError: if a distribution is not a ``TanhNormal``.
        ValueError: if bounds differ or a number is out of its range; in the call, if
            the batch is empty or holds several steps a row.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import OSRLoss, StatePerturbation
        >>> from torchrl_osr.modules import (
        ...     critic_ensemble, tanh_gaussian_actor, tanh_gaussian_inverse_dynamics)
        >>> loss = OSRLoss(tanh_gaussian_actor(11, 3), critic_ensemble(11, 3),
        ...                tanh_gaussian_inverse_dynamics(11, 3))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> losses = loss(StatePerturbation(std=1e-3)(batch))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_cql', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"recovery_weight", "min_q_weight"})
    reads_perturbed = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        recovery_weight: float = 0.5,
        min_q_weight: float = 5.0,
        num_random: int = 10,
        temperature: float = 1.0,
        target_action_gap: float | None = None,
        clip_diff_min: float = -math.inf,
        max_q_backup: bool = False,
        deterministic_backup: bool = True,
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        delay_actor: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        networks = actor_network, qvalue_network, inverse_dynamics_network
        self.register_action_bounds(actor_network, inverse_dynamics_network)
        self.register_actor_critic(*networks, delay_actor=delay_actor)
        self.register_temperature(alpha_init, fixed_alpha, target_entropy)
        self.register_coefficient("recovery_weight", recovery_weight)
        gap = temperature, target_action_gap, clip_diff_min
        backup = max_q_backup, deterministic_backup
        self.register_conservative_penalty(min_q_weight, num_random, *gap, *backup)
        self.declare_soft_actor_critic("recovery_kl")
        self.make_value_estimator()

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        objective, log_prob = self.soft_policy_objective(batch, policy, "both")
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob)
        recovery = self.recovery(batch, policy)
        term = self.reduce(recovery, batch, batch.has_next)
        losses["loss_actor"] = losses["loss_actor"] + self.recovery_weight * term
        metrics["recovery_kl"] = self.mean(recovery, batch, batch.has_next)
        critics, values = self.critic_losses(batch, policy)
        return losses | critics, metrics | values

    def recovery(self, batch: Transitions, policy: StatePolicy) -> Tensor:
        """Return the state-recovery term (11), the mean over D_tot, ``[R]``."""
        pi, model = policy["both"], self.inverse_dynamics(batch, "both")
        sizes = model.loc.shape[-1], pi.loc.shape[-1]
        check_num_actions("inverse_dynamics_network", *sizes)
        divergence = F.state_recovery(pi.loc, pi.scale, model.loc, model.scale)
        return divergence.mean(0)
