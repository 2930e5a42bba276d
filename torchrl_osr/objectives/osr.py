r"""OSR: conservative Q-learning with a policy that learns to return to the data.

Shapes: ``R`` rows, ``A`` action, ``N`` critics, ``K`` sampled actions of a kind. The
equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from torchrl_osr import functional as F
from torchrl_osr.objectives.actor_critic import Losses, StatePolicy
from torchrl_osr.objectives.cql import CQLLoss
from torchrl_osr.objectives.networks import check_num_actions
from torchrl_osr.objectives.transitions import States, Transitions


class OSRLoss(CQLLoss):
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
    only: add them up for one backward, or use separate optimizers.

    Args:
        actor_network, qvalue_network: see :class:`~torchrl_osr.CQLLoss`.
        inverse_dynamics_network: a *trained* model of ``I(a | s, s')`` with the
            actor's bounds (see :class:`~torchrl_osr.InverseDynamicsLoss`). It is frozen
            here: in the state dict, moved by ``.to()``, without gradient.

    Keyword Args:
        recovery_weight: weight :math:`\lambda` of the sum over action entries. Default
            0.5, which the released code gives their mean. May be assigned later.
        actor_states: states of the sought values: ``"both"`` (default) for D_tot,
            ``"clean"`` or ``"perturbed"``.
        options: of :class:`~torchrl_osr.CQLLoss`, such as ``min_q_weight``.

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

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential,
        *,
        recovery_weight: float = 0.5,
        actor_states: States = "both",
        **options: Any,
    ) -> None:
        networks = actor_network, qvalue_network
        super().__init__(*networks, actor_states=actor_states, **options)
        self.reads_perturbed = True
        self.register_model(inverse_dynamics_network)
        self.register_coefficient("recovery_weight", recovery_weight)
        self.declare_soft_actor_critic("recovery_kl")

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        losses, metrics = self.cql_losses(batch, policy)
        recovery = self.recovery(batch, policy)
        term = self.reduce(recovery, batch, batch.has_next)
        losses["loss_actor"] = losses["loss_actor"] + self.recovery_weight * term
        metrics["recovery_kl"] = self.mean(recovery, batch, batch.has_next)
        return losses, metrics

    def recovery(self, batch: Transitions, policy: StatePolicy) -> Tensor:
        """Return the state-recovery term (11), the mean over D_tot, ``[R]``."""
        pi, model = policy["both"], self.inverse_dynamics(batch, "both")
        check_num_actions("inverse_dynamics_network", model.loc, pi.loc)
        return F.state_recovery(pi.loc, pi.scale, model.loc, model.scale).mean(0)
