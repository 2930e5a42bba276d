r"""Fitted Q evaluation: the value of a policy that is not trained.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torchrl.objectives import distance_loss

from torchrl_osr._entries import entry, nested
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.transitions import Transitions


class FQELoss(ActorCriticLoss):
    r"""Fitted Q evaluation (FQE).

    .. math::
        L_Q = \sum_i \mathbb E_D\, w_i\, \bigl(Q_i(s, a) - r
            - \gamma\,(1 - \text{terminated})\,\bar Q_i(s', a')\bigr)^2

    The action :math:`a'` of the policy at :math:`s'` is ``("next", "action")`` in the
    batch: any policy can be evaluated, also the data's. Each critic has a target of its
    own, unlike in training, where the smallest value of all is the target. The weights
    :math:`w_i`, the optional entry ``"bootstrap"`` ``[B, N]``, resample the episodes.

    "Batch Policy Learning under Constraints", https://arxiv.org/abs/1903.08738;
    "Bootstrapping Fitted Q-Evaluation", https://arxiv.org/abs/2102.03607.

    Keyword Args:
        value_bounds: smallest and largest possible value. Clips the targets, and so
            prevents divergence. Default: none.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.
    """

    def __init__(
        self,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        value_bounds: tuple[float, float] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.register_critics(qvalue_network)
        self.value_bounds = value_bounds
        self.declare(["loss_qvalue"], ["pred_value", "target_value"])

    def input_keys(self) -> list[NestedKey]:
        return [*super().input_keys(), nested("next", self.tensor_keys.action)]

    def losses(self, batch: Transitions) -> Losses:
        action = entry(batch.rows, nested("next", self.tensor_keys.action))
        with torch.no_grad():
            next_value = self.q(batch.s_next, action, self.target_qvalue_network_params)
            target = torch.stack([self.td_target(batch, each) for each in next_value])
            if self.value_bounds is not None:
                target = target.clamp(*self.value_bounds)
        self.check_actions(batch, action.shape)
        value = self.q(batch.s, batch.a)
        _, metrics = self.td_error(batch, value, target)
        distance = distance_loss(value, target, self.loss_function)
        weight = batch.tensordict.get("bootstrap", None)
        if weight is not None:
            distance = distance * weight.reshape(-1, len(value)).T
        return {"loss_qvalue": self.reduce(distance.sum(0), batch)}, metrics
