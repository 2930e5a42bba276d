r"""ReBRAC: TD3+BC with a second penalty, in the critics' target.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_osr import functional as F
from torchrl_osr._checks import check_weight
from torchrl_osr._entries import column, entry, nested
from torchrl_osr.lab.losses.td3 import TD3Loss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.networks import check_action
from torchrl_osr.objectives.transitions import Transitions


class ReBRACLoss(TD3Loss):
    r"""Revisited behaviour-regularised actor-critic (ReBRAC).

    .. math::
        L_\pi &= \mathbb E_D \Big[ \beta_1 \|\pi(s) - a\|^2
            - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|} \Big]
            \\
        T &= r + \gamma\,(1 - \text{terminated}) \Big[ \min_i \bar Q_i(s', \tilde a')
            - \beta_2 \|\tilde a' - a'\|^2 \Big], \quad
        \tilde a' = \bar\pi(s') + \epsilon

    and otherwise :class:`~torchrl_osr.lab.losses.td3.TD3Loss`. "Revisiting the
    Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2305.09836; the paper prints no normaliser, its code has one.
    The critics should have layer normalisation.

    :math:`a'` is the data's action at :math:`s'`, the entry ``("next", "action")``. In
    rows that are ``done`` it is unknown, and the penalty does not count.

    Keyword Args:
        actor_bc_coef: :math:`\beta_1`. Default 0.01.
        critic_bc_coef: :math:`\beta_2`. Default 0.01; with 0 no next action is read.
        options: of :class:`~torchrl_osr.lab.losses.td3.TD3Loss`.

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
        **options: Any,
    ) -> None:
        check_weight("actor_bc_coef", actor_bc_coef)
        check_weight("critic_bc_coef", critic_bc_coef)
        super().__init__(actor_network, qvalue_network, **options)
        self.actor_bc_coef, self.critic_bc_coef = actor_bc_coef, critic_bc_coef

    def input_keys(self) -> list[NestedKey]:
        keys = super().input_keys()
        if self.critic_bc_coef:
            keys.append(nested("next", self.tensor_keys.action))
        return keys

    def losses(self, batch: Transitions) -> Losses:
        action, qvalues = self.policy_values(batch)
        lowest = qvalues.min(0).values
        distance = batch.of_data(F.action_distance(action, batch.a))
        sought = lowest / self.magnitude(batch, lowest)
        actor = self.reduce(self.actor_bc_coef * distance - sought, batch)
        qvalue, metrics = self.critic_loss(batch)
        metrics["cloning_error"] = self.mean(distance, batch, batch.is_data)
        return {"loss_actor": actor, "loss_qvalue": qvalue}, metrics

    def next_value(self, batch: Transitions) -> Tensor:
        """Return the value of the next state less its penalty, ``[R]``."""
        action, value = self.smoothed(batch)
        if not self.critic_bc_coef:
            return value
        key = nested("next", self.tensor_keys.action)
        data_action = entry(batch.rows, key)
        check_action(data_action, action.shape, key)
        done = column(batch.rows, nested("next", self.tensor_keys.done))
        penalty = F.action_distance(action, data_action).masked_fill(done, 0.0)
        return value - self.critic_bc_coef * penalty
