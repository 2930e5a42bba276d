r"""TD3+BC: a deterministic policy that seeks values and stays with the data's actions.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictModuleBase

from torchrl_osr._checks import check_weight
from torchrl_osr.lab.losses.td3 import TD3Loss
from torchrl_osr.objectives.actor_critic import Losses
from torchrl_osr.objectives.transitions import Transitions


class TD3BCLoss(TD3Loss):
    r"""TD3 with behaviour cloning (TD3+BC).

    .. math::
        L_\pi = \mathbb E_D \Big[ \|\pi(s) - a\|^2 / A
            - \frac{\alpha}{\mathbb E_D |Q_1(s, \pi(s))|}\, Q_1(s, \pi(s)) \Big]

    and TD3's critics, see :class:`~torchrl_osr.lab.losses.td3.TD3Loss`. "A Minimalist
    Approach to Offline Reinforcement Learning", https://arxiv.org/abs/2106.06860,
    equations (3) to (5). In TorchRL 0.14.1's ``TD3BCLoss`` the cloning term is a mean
    over the batch that is added to each row: masks and priority weights do not reach
    it.

    Keyword Args:
        alpha: weight of the values against cloning. Default 2.5.
        options: of :class:`~torchrl_osr.lab.losses.td3.TD3Loss`.

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
        **options: Any,
    ) -> None:
        check_weight("alpha", alpha)
        super().__init__(actor_network, qvalue_network, **options)
        self.weight_of_values = alpha

    def losses(self, batch: Transitions) -> Losses:
        action, qvalues = self.policy_values(batch)
        cloning = batch.of_data((action - batch.a).square().mean(-1))
        weight = self.weight_of_values / self.magnitude(batch, qvalues[0])
        actor = self.reduce(cloning - weight * qvalues[0], batch)
        qvalue, metrics = self.critic_loss(batch)
        metrics["cloning_error"] = self.mean(cloning, batch, batch.is_data)
        return {"loss_actor": actor, "loss_qvalue": qvalue}, metrics
