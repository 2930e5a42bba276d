r"""ReBRAC: TD3+BC with a second penalty, in the critics' target.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_osr import functional as F
from torchrl_osr._checks import check_weight
from torchrl_osr._entries import column, entry, nested
from torchrl_osr.lab.losses.td3 import (
    TargetPolicySmoothing,
    magnitude,
    register_td3,
)
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import check_action
from torchrl_osr.objectives.transitions import Transitions


def rebrac_objective(
    qvalue: Tensor, distance: Tensor, magnitude: Tensor, weight: float
) -> Tensor:
    r"""ReBRAC objective of the policy, to be minimised.

    .. math::
        \beta_1 \|\pi(s) - a\|^2
        - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|}

    As its released code has it: the paper prints no normaliser.

    Args:
        qvalue: the critics' smallest value of the policy's action, ``[R]``.
        distance: of that action from the data's, squared, ``[R]``.
        magnitude: the normaliser, a scalar without gradient.
        weight: :math:`\beta_1`.

    Returns:
        ``[R]``.

    Examples:
        >>> one = torch.ones(1)
        >>> rebrac_objective(4 * one, 3 * one, magnitude=2 * one, weight=0.5)
        tensor([-0.5000])
    """
    return weight * distance - qvalue / magnitude


class ReBRACLoss(ActorCriticLoss):
    r"""Revisited behaviour-regularised actor-critic (ReBRAC).

    .. math::
        L_\pi &= \mathbb E_D \Big[ \beta_1 \|\pi(s) - a\|^2
            - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|} \Big]
            \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2, \quad
        T = r + \gamma\,(1 - \text{terminated}) \Big[ \min_i \bar Q_i(s', \tilde a')
            - \beta_2 \|\tilde a' - a'\|^2 \Big], \quad
        \tilde a' = \bar\pi(s') + \epsilon

    "Revisiting the Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2305.09836. The critics should have layer normalisation. The
    authors update policy and targets every second step; that is the training loop's
    part.

    :math:`a'` is what the data did at :math:`s'`, the entry ``("next", "action")``.
    Where an episode was cut it is unknown: there the penalty does not count.

    Args:
        actor_network: writes the action; see
            :func:`~torchrl_osr.modules.deterministic_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics.

    Keyword Args:
        actor_bc_coef: :math:`\beta_1`, weight of the policy's distance from the data's
            action. Default 0.01.
        critic_bc_coef: :math:`\beta_2`, weight of the same in the target. Default 0.01;
            with 0 *here* no next action is read.
        policy_noise: standard deviation of :math:`\epsilon`, in units of the action.
            Default 0.2.
        noise_clip: largest magnitude of :math:`\epsilon`. Default 0.5.
        low, high: action bounds, numbers or ``[A]``; needed unless the actor ends in a
            :class:`~torchrl.modules.TanhDelta`, which has them.
        options: of every loss, see
            :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Raises:
        ValueError: if bounds are missing, or a number is out of its range.
        KeyError: in the call, if the batch has no next action.

    Examples:
        >>> from torchrl_osr.lab.losses import ReBRACLoss
        >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
        >>> critics = critic_ensemble(11, 3, layer_norm=True)
        >>> loss = ReBRACLoss(deterministic_actor(11, 3), critics)
        >>> ("next", "action") in loss.in_keys
        True
    """

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        actor_bc_coef: float = 0.01,
        critic_bc_coef: float = 0.01,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        low: Any = None,
        high: Any = None,
        **options: Any,
    ) -> None:
        check_weight("actor_bc_coef", actor_bc_coef)
        check_weight("critic_bc_coef", critic_bc_coef)
        super().__init__(**options)
        self.smoothing = TargetPolicySmoothing(policy_noise, noise_clip)
        register_td3(self, actor_network, qvalue_network, low, high)
        self.actor_bc_coef, self.critic_bc_coef = actor_bc_coef, critic_bc_coef
        metrics = ["cloning_error", "pred_value", "target_value"]
        self.declare(["loss_actor", "loss_qvalue"], metrics)

    def input_keys(self) -> list[NestedKey]:
        keys = super().input_keys()
        if self.critic_bc_coef:
            keys.append(nested("next", self.tensor_keys.action))
        return keys

    def losses(self, batch: Transitions) -> Losses:
        action = self.act(batch.s, self.actor_network_params)
        self.check_actions(batch, action.shape)
        # Detached: the policy's objective must not train the critics.
        params = self.qvalue_network_params.detach()
        qvalue = self.q(batch.s, action, params).min(0).values
        distance = batch.of_data(F.action_distance(action, batch.a))
        scale = magnitude(self, batch, qvalue)
        objective = rebrac_objective(qvalue, distance, scale, self.actor_bc_coef)
        target = self.penalised_target(batch)
        error, metrics = self.td_error(batch, self.q(batch.s, batch.a), target)
        metrics["cloning_error"] = self.mean(distance, batch, batch.is_data)
        return {
            "loss_actor": self.reduce(objective, batch),
            "loss_qvalue": self.reduce(error, batch),
        }, metrics

    @torch.no_grad()
    def penalised_target(self, batch: Transitions) -> Tensor:
        """Return the TD target less the penalty of its action, ``[R]``."""
        action, next_value = self.smoothing(self, batch)
        if self.critic_bc_coef:
            key = nested("next", self.tensor_keys.action)
            data_action = entry(batch.rows, key)
            check_action(data_action, action.shape, key)
            done = column(batch.rows, nested("next", self.tensor_keys.done))
            penalty = F.action_distance(action, data_action).masked_fill(done, 0.0)
            next_value = next_value - self.critic_bc_coef * penalty
        return self.td_target(batch, next_value)
