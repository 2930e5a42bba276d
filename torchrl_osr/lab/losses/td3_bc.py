r"""TD3+BC: a deterministic policy that seeks values and stays with the data's actions.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_osr._checks import check_weight
from torchrl_osr.lab.losses.td3 import (
    TargetPolicySmoothing,
    cloning_error,
    magnitude,
    register_td3,
)
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.transitions import Transitions


def td3_bc_objective(
    qvalue: Tensor, cloning_error: Tensor, magnitude: Tensor, alpha: float
) -> Tensor:
    r"""TD3+BC objective of the policy, to be minimised, equations (3) to (5).

    .. math::
        \frac1A \|\pi(s) - a\|^2
        - \frac{\alpha}{\mathbb E_D |Q(s, \pi(s))|}\, Q(s, \pi(s))

    Args:
        qvalue: value of the policy's action, ``[R]``.
        cloning_error: the first term, ``[R]``.
        magnitude: :math:`\mathbb E_D |Q(s, \pi(s))|`, a scalar without gradient.
        alpha: weight of the values.

    Returns:
        ``[R]``.

    Examples:
        >>> one = torch.ones(1)
        >>> td3_bc_objective(4 * one, 0.5 * one, magnitude=2 * one, alpha=2.5)
        tensor([-4.5000])
    """
    return cloning_error - alpha / magnitude * qvalue


class TD3BCLoss(ActorCriticLoss):
    r"""TD3 with behaviour cloning (TD3+BC).

    .. math::
        L_\pi &= \mathbb E_D \Big[ \|\pi(s) - a\|^2 / A
            - \frac{\alpha}{\mathbb E_D |Q_1(s, \pi(s))|}\, Q_1(s, \pi(s)) \Big] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2, \quad
        T = r + \gamma\,(1 - \text{terminated}) \min_i
            \bar Q_i(s', \bar\pi(s') + \epsilon)

    "A Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2106.06860. In TorchRL 0.14.1's ``TD3BCLoss`` the cloning term
    is a mean over the batch that is added to each row: masks and priority weights do
    not reach it. The authors update policy and targets every second step; that is the
    training loop's part.

    Args:
        actor_network: writes the action; see
            :func:`~torchrl_osr.modules.deterministic_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics.

    Keyword Args:
        alpha: weight of the values against cloning. Default 2.5.
        policy_noise: standard deviation of :math:`\epsilon`, in units of the action.
            Default 0.2.
        noise_clip: largest magnitude of :math:`\epsilon`. Default 0.5.
        low, high: action bounds, numbers or ``[A]``; needed unless the actor ends in a
            :class:`~torchrl.modules.TanhDelta`, which has them.
        options: of every loss, see
            :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Raises:
        ValueError: if bounds are missing, or a number is out of its range.

    Examples:
        >>> from torchrl_osr.lab.losses import TD3BCLoss
        >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
        >>> loss = TD3BCLoss(deterministic_actor(11, 3), critic_ensemble(11, 3))
        >>> loss.out_keys
        ['loss_actor', 'loss_qvalue', 'cloning_error', 'pred_value', 'target_value']
    """

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        alpha: float = 2.5,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        low: Any = None,
        high: Any = None,
        **options: Any,
    ) -> None:
        check_weight("alpha", alpha)
        super().__init__(**options)
        self.smoothing = TargetPolicySmoothing(policy_noise, noise_clip)
        register_td3(self, actor_network, qvalue_network, low, high)
        self.weight_of_values = alpha
        metrics = ["cloning_error", "pred_value", "target_value"]
        self.declare(["loss_actor", "loss_qvalue"], metrics)

    def losses(self, batch: Transitions) -> Losses:
        action = self.act(batch.s, self.actor_network_params)
        self.check_actions(batch, action.shape)
        # Detached: the policy's objective must not train the critics.
        qvalue = self.q(batch.s, action, self.qvalue_network_params.detach())[0]
        cloning = batch.of_data(cloning_error(action, batch.a))
        scale = magnitude(self, batch, qvalue)
        objective = td3_bc_objective(qvalue, cloning, scale, self.weight_of_values)
        with torch.no_grad():
            _, next_value = self.smoothing(self, batch)
            target = self.td_target(batch, next_value)
        error, metrics = self.td_error(batch, self.q(batch.s, batch.a), target)
        metrics["cloning_error"] = self.mean(cloning, batch, batch.is_data)
        return {
            "loss_actor": self.reduce(objective, batch),
            "loss_qvalue": self.reduce(error, batch),
        }, metrics
