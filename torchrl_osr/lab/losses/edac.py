r"""EDAC: an ensemble of critics that differ in how values change with the action.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.nn.functional import normalize
from torchrl.objectives.utils import _vmap_func

from torchrl_osr._checks import check_positive
from torchrl_osr._entries import state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.transitions import Transitions


def gradient_diversity(action_gradients: Tensor) -> Tensor:
    """Return the diversity term of gradients ``[N, R, A]``, ``[R]``."""
    # Without eps, a dead critic's zero gradient would be 0 / 0.
    unit = normalize(action_gradients, dim=-1, eps=1e-10)
    # All pairs at once: |sum_i g_i|^2 - sum_i |g_i|^2, with |g_i| = 1.
    pairs = unit.sum(0).square().sum(-1) - unit.square().sum((0, -1))
    return pairs / (len(action_gradients) - 1)


class EDACLoss(ActorCriticLoss):
    r"""Ensemble-Diversified Actor-Critic (EDAC).

    .. math::
        L_\pi &= \mathbb E_D
            [\alpha_e \log\pi(\hat a \mid s) - \min_i Q_i(s, \hat a)] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \eta\, \mathbb E_D
            \frac{1}{N - 1} \sum_{i \ne j} \Big\langle
            \frac{\nabla_a Q_i}{\|\nabla_a Q_i\|},
            \frac{\nabla_a Q_j}{\|\nabla_a Q_j\|} \Big\rangle \\
        T &= r + \gamma\,(1 - \text{terminated})
            [\min_i \bar Q_i(s', a') - \alpha_e \log\pi(a' \mid s')]

    "Uncertainty-Based Offline Reinforcement Learning with Diversified Q-Ensemble",
    https://arxiv.org/abs/2110.01548. Without the diversity it is SAC-N, see
    :class:`~torchrl_osr.CQLLoss`. ``loss_qvalue`` holds both terms of :math:`L_Q`.

    Keyword Args:
        diversity_weight: :math:`\eta`. Default 1.0. May be assigned later.
        alpha_init, target_entropy: see :class:`~torchrl_osr.CQLLoss`.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.losses import EDACLoss
        >>> from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
        >>> critics = critic_ensemble(11, 3, num_qvalue_nets=4)
        >>> loss = EDACLoss(tanh_gaussian_actor(11, 3), critics)
        >>> loss.out_keys[:3]
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"diversity_weight"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        diversity_weight: float = 1.0,
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        super().__init__(**options)
        networks = actor_network, qvalue_network
        self.register_soft_actor_critic(*networks, alpha_init, target_entropy)
        check_positive("num_qvalue_nets", self.num_qvalue_nets, minimum=2)
        self.register_coefficient("diversity_weight", diversity_weight)
        self.declare_soft_actor_critic("diversity")
        self.make_value_estimator()

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        objective, log_prob = self.soft_policy_objective(batch, policy, "clean")
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob)
        q_data = self.q(batch.s, batch.a)
        diversity = gradient_diversity(self.action_gradients(batch))
        error, values = self.td_error(batch, q_data, self.soft_target(batch, policy))
        qvalue = self.reduce(error + self.diversity_weight * diversity, batch)
        metrics["diversity"] = self.mean(diversity, batch)
        return losses | {"loss_qvalue": qvalue}, metrics | values

    def action_gradients(self, batch: Transitions) -> Tensor:
        """Return each critic's gradient by the data's action, ``[N, R, A]``."""
        number, keys = self.num_qvalue_nets, self.tensor_keys
        states = batch.s.select(*state_keys(self.qvalue_network.in_keys), strict=False)
        states = states.expand(number, *states.batch_size)
        params = self.qvalue_network_params
        # Each critic at actions of its own, for its own gradient.
        critics = _vmap_func(
            self.qvalue_network, (0, 0), pseudo_vmap=self.deactivate_vmap
        )

        def total(action: Tensor) -> Tensor:
            rows = critics(states.copy().set(keys.action, action), params)
            value: Tensor = rows.get(keys.state_action_value)
            return value.sum()

        # torch.func, unlike torch.autograd.grad, can be compiled; both can be
        # differentiated once more.
        gradient: Tensor = torch.func.grad(total)(batch.a.expand(number, -1, -1))
        return gradient
