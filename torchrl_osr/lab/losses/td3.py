r"""TD3 with a deterministic actor that stays with the data: TD3+BC and ReBRAC.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_osr import functional as F
from torchrl_osr._checks import check_weight
from torchrl_osr._entries import column, entry, nested
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import check_action, squashing_bounds
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
        policy_noise: scale of :math:`\epsilon`, in units of the action. Default 0.2.
        noise_clip: largest magnitude of :math:`\epsilon`. Default 0.5.
        low, high: action bounds, numbers or ``[A]``. Those of an actor that ends in a
            :class:`~torchrl.modules.TanhDelta` are the actor's.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.
    """

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
        if not squashing_bounds(actor_network):  # else registered with the actor
            if low is None or high is None:
                raise ValueError(
                    "The actor's module has no action bounds: pass low= and high= of "
                    "the environment's actions."
                )
            device = next(actor_network.parameters()).device
            bounds = [torch.as_tensor(each, device=device) for each in (low, high)]
            self.register_bounds(each.float() for each in bounds)
        self.register_actor_critic(actor_network, qvalue_network, delay_actor=True)
        metrics = ["cloning_error", "pred_value", "target_value"]
        self.declare(["loss_actor", "loss_qvalue"], metrics)

    @abstractmethod
    def objective(
        self, batch: Transitions, action: Tensor, qvalues: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return what the policy minimises and its distance from the data, ``[R]``.

        The policy's actions are ``[R, A]``, their values ``[N, R]``.
        """

    def losses(self, batch: Transitions) -> Losses:
        action = self.act(batch.s, self.actor_network_params)
        self.check_actions(batch, action.shape)
        qvalues = self.q(batch.s, action, self.frozen_critics)
        objective, distance = self.objective(batch, action, qvalues)
        with torch.no_grad():
            target = self.td_target(batch, self.next_value(batch))
        error, metrics = self.td_error(batch, self.q(batch.s, batch.a), target)
        metrics["cloning_error"] = self.mean(distance, batch, batch.is_data)
        terms = {"loss_actor": objective, "loss_qvalue": error}
        return {name: self.reduce(each, batch) for name, each in terms.items()}, metrics

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


class TD3BCLoss(TD3Loss):
    r"""TD3 with behaviour cloning (TD3+BC).

    .. math::
        L_\pi = \mathbb E_D \Big[ \|\pi(s) - a\|^2 / A
            - \frac{\alpha}{\mathbb E_D |Q_1(s, \pi(s))|}\, Q_1(s, \pi(s)) \Big]

    and the critics of :class:`~torchrl_osr.lab.losses.td3.TD3Loss`. "A Minimalist
    Approach to Offline Reinforcement Learning", https://arxiv.org/abs/2106.06860,
    equations (3) to (5). Unlike in TorchRL 0.14.1's ``TD3BCLoss``, masks and priority
    weights reach the cloning term.

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

    def objective(
        self, batch: Transitions, action: Tensor, qvalues: Tensor
    ) -> tuple[Tensor, Tensor]:
        cloning = batch.of_data((action - batch.a).square().mean(-1))
        weight = self.weight_of_values / self.magnitude(batch, qvalues[0])
        return cloning - weight * qvalues[0], cloning


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
    https://arxiv.org/abs/2305.09836; the normaliser is that of its code. The critics
    should have layer normalisation.

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
        # First: input_keys, which the constructor calls, depends on them.
        self.actor_bc_coef, self.critic_bc_coef = actor_bc_coef, critic_bc_coef
        super().__init__(actor_network, qvalue_network, **options)

    def input_keys(self) -> list[NestedKey]:
        keys = super().input_keys()
        if self.critic_bc_coef:
            keys.append(nested("next", self.tensor_keys.action))
        return keys

    def objective(
        self, batch: Transitions, action: Tensor, qvalues: Tensor
    ) -> tuple[Tensor, Tensor]:
        lowest = qvalues.min(0).values
        distance = batch.of_data((action - batch.a).square().sum(-1))
        sought = lowest / self.magnitude(batch, lowest)
        return self.actor_bc_coef * distance - sought, distance

    def next_value(self, batch: Transitions) -> Tensor:
        """Return the value of the next state less its penalty, ``[R]``."""
        action, value = self.smoothed(batch)
        if not self.critic_bc_coef:
            return value
        key = nested("next", self.tensor_keys.action)
        data_action = entry(batch.rows, key)
        check_action(data_action, action.shape, key)
        done = column(batch.rows, nested("next", self.tensor_keys.done))
        penalty = (action - data_action).square().sum(-1).masked_fill(done, 0.0)
        return value - self.critic_bc_coef * penalty
