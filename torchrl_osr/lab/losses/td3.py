r"""Base of TD3+BC, ReBRAC and SCAS: TD3's critics and a deterministic actor.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.modules import TanhDelta

from torchrl_osr import functional as F
from torchrl_osr._checks import check_weight
from torchrl_osr.objectives.actor_critic import ActorCriticLoss
from torchrl_osr.objectives.networks import bounds_of, head_of
from torchrl_osr.objectives.transitions import Transitions


class TD3Loss(ActorCriticLoss):
    r"""TD3 without its actor's loss, https://arxiv.org/abs/1802.09477.

    .. math::
        L_Q = \sum_i \mathbb E_D (Q_i - T)^2, \quad
        T = r + \gamma\,(1 - \text{terminated}) \min_i
            \bar Q_i(s', \bar\pi(s') + \epsilon)

    with clipped Gaussian noise :math:`\epsilon`. The authors update policy and targets
    every second step; that is the training loop's part.

    Keyword Args:
        policy_noise: standard deviation of :math:`\epsilon`, in units of the action.
            Default 0.2.
        noise_clip: largest magnitude of :math:`\epsilon`. Default 0.5.
        low, high: action bounds, numbers or ``[A]``; needed unless the actor ends in a
            :class:`~torchrl.modules.TanhDelta`, which has them.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.
    """

    metric = "cloning_error"

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        low: Any = None,
        high: Any = None,
        **options: Any,
    ) -> None:
        check_weight("policy_noise", policy_noise)
        check_weight("noise_clip", noise_clip)
        super().__init__(**options)
        self.policy_noise, self.noise_clip = policy_noise, noise_clip
        head, found = head_of(actor_network)
        own = bounds_of(found) if head is TanhDelta else (None, None)
        for name, given, actors in zip(("low", "high"), (low, high), own, strict=True):
            if given is None and actors is None:
                raise ValueError(
                    f"{name} is missing. Pass low= and high= of the environment's "
                    "actions: the actor's module does not have them."
                )
            bound = torch.as_tensor(actors if given is None else given).float()
            if actors is not None and not torch.equal(bound.expand_as(actors), actors):
                raise ValueError(
                    f"the loss has {name}={bound.tolist()}, but its actor "
                    f"{name}={actors.tolist()}: leave it out."
                )
            self.register_buffer(f"action_{name}", bound, persistent=False)
        if not bool((self.action_low < self.action_high).all()):
            raise ValueError(f"high must be above low={low}, got {high}.")
        self.register_actor_critic(
            actor_network, qvalue_network, delay_actor=self.delay_qvalue
        )
        self.make_value_estimator()
        metrics = [self.metric, "pred_value", "target_value"]
        self.declare(["loss_actor", "loss_qvalue"], metrics)

    def policy_values(self, batch: Transitions) -> tuple[Tensor, Tensor]:
        """Return the policy's actions, ``[R, A]``, and their values, ``[N, R]``."""
        action = self.act(batch.s, self.actor_network_params)
        self.check_actions(batch, action.shape)
        # Detached: the policy's objective must not train the critics.
        return action, self.q(batch.s, action, self.qvalue_network_params.detach())

    def magnitude(self, batch: Transitions, value: Tensor) -> Tensor:
        """Return the mean magnitude of values ``[R]``, detached; 1 where it is 0."""
        mean = self.mean(value.abs(), batch)
        return torch.where(mean == 0, torch.ones_like(mean), mean)

    def smoothed(self, batch: Transitions) -> tuple[Tensor, Tensor]:
        """Return the target's action, ``[R, A]``, and its smallest value, ``[R]``."""
        action = self.act(batch.s_next, self.target_actor_network_params)
        noise = self.policy_noise * torch.randn_like(action)
        noise = noise.clamp(-self.noise_clip, self.noise_clip)
        action = (action + noise).clamp(self.action_low, self.action_high)
        qvalue = self.q(batch.s_next, action, self.target_qvalue_network_params)
        return action, F.bootstrap_value(qvalue)

    def next_value(self, batch: Transitions) -> Tensor:
        """Return the value of the next state in the TD target, ``[R]``."""
        return self.smoothed(batch)[1]

    def critic_loss(self, batch: Transitions) -> tuple[Tensor, dict[str, Tensor]]:
        """Return :math:`L_Q`, reduced, and its metrics."""
        with torch.no_grad():
            target = self.td_target(batch, self.next_value(batch))
        error, metrics = self.td_error(batch, self.q(batch.s, batch.a), target)
        return self.reduce(error, batch), metrics
