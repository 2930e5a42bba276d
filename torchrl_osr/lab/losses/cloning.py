r"""Policies that clone: behaviour cloning, and IQL, which clones by advantage.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
)
from torch import Tensor

from torchrl_osr._checks import check_weight
from torchrl_osr._entries import state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.networks import (
    distribution,
    squashing_bounds,
    written_entry,
)
from torchrl_osr.objectives.state_recovery import cloning_distance, policy_at
from torchrl_osr.objectives.transitions import Transitions


class BCLoss(ActorCriticLoss):
    r"""Behaviour cloning (BC).

    .. math::
        L_\pi = -\mathbb E_D \log\pi(a \mid s)

    and :math:`\mathbb E_D \|\pi(s) - a\|^2` of a deterministic actor. The actor may
    have discrete actions. Noisy behaviour cloning, on D_tot, is
    :class:`~torchrl_osr.StateRecoveryLoss` with ``recovery_target="data"``.

    Keyword Args:
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.losses import BCLoss
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> BCLoss(tanh_gaussian_actor(11, 3)).in_keys
        ['observation', 'action']
    """

    def __init__(self, actor_network: TensorDictModuleBase, **options: Any) -> None:
        super().__init__(**options)
        self.convert_to_functional(actor_network, "actor_network")
        self.register_bounds(squashing_bounds(actor_network))
        self.declare(["loss_actor"], [])

    def input_keys(self) -> list[NestedKey]:
        return [*state_keys(self.actor_network.in_keys), self.tensor_keys.action]

    def losses(self, batch: Transitions) -> Losses:
        network, key = self.actor_network, self.tensor_keys.action
        states = batch.states_of(state_keys(network.in_keys), "clean")
        pi = policy_at(network, self.actor_network_params, states, key)
        distance = cloning_distance(pi, batch.a, key).mean(0)
        self.check_actions(batch, batch.a.shape)
        return {"loss_actor": self.reduce(distance, batch, batch.is_data)}, {}


class IQLLoss(ActorCriticLoss):
    r"""Implicit Q-learning (IQL).

    .. math::
        u &= \min_i \bar Q_i(s, a) - V(s) \\
        L_V &= \mathbb E_D |\tau - 1(u < 0)|\, u^2, \quad
        L_Q = \sum_i \mathbb E_D
            (Q_i - r - \gamma\,(1 - \text{terminated}) V(s'))^2 \\
        L_\pi &= -\mathbb E_D \min(e^{\beta u}, 100) \log\pi(a \mid s)

    "Offline Reinforcement Learning with Implicit Q-Learning",
    https://arxiv.org/abs/2110.06169. The authors' actor is
    :func:`~torchrl_osr.modules.gaussian_actor`, and they update :math:`V` first.

    Keyword Args:
        temperature: :math:`\beta`. Default 3.0, the authors' for robots, whose
            rewards they scale; mazes 10.0.
        expectile: :math:`\tau`. Default 0.7, the authors' for robots; mazes 0.9.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr.lab.losses import IQLLoss
        >>> from torchrl_osr.modules import critic_ensemble, gaussian_actor, state_value
        >>> critics = critic_ensemble(11, 3)
        >>> loss = IQLLoss(gaussian_actor(11, 3), critics, state_value(11))
        >>> loss.out_keys[:3]
        ['loss_actor', 'loss_qvalue', 'loss_value']
    """

    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        value_network: TensorDictModule,
        *,
        temperature: float = 3.0,
        expectile: float = 0.7,
        **options: Any,
    ) -> None:
        check_weight("temperature", temperature)
        if not 0 < expectile < 1:
            raise ValueError(f"expectile must be between 0 and 1, got {expectile}.")
        super().__init__(**options)
        self.register_actor_critic(actor_network, qvalue_network)
        self.convert_to_functional(value_network, "value_network")
        self.temperature, self.expectile = temperature, expectile
        losses = ["loss_actor", "loss_qvalue", "loss_value"]
        self.declare(losses, ["nll", "pred_value", "target_value"])

    def losses(self, batch: Transitions) -> Losses:
        params = self.actor_network_params
        pi = distribution(self.actor_network, params, batch.states[:1])
        nll = cloning_distance(pi, batch.a, self.tensor_keys.action).squeeze(0)
        self.check_actions(batch, batch.a.shape)
        with torch.no_grad():
            target_params = self.target_qvalue_network_params
            best = self.q(batch.s, batch.a, target_params).min(0).values
            target = self.td_target(batch, self.state_value(batch.s_next))
        advantage = best - self.state_value(batch.s)
        weight = (self.temperature * advantage.detach()).exp().clamp(max=100)
        error, metrics = self.td_error(batch, self.q(batch.s, batch.a), target)
        tau = torch.where(advantage < 0, 1 - self.expectile, self.expectile)
        losses = {
            "loss_actor": self.reduce(weight * nll, batch),
            "loss_qvalue": self.reduce(error, batch),
            "loss_value": self.reduce(tau * advantage.square(), batch),
        }
        return losses, metrics | {"nll": self.mean(nll, batch)}

    def state_value(self, states: TensorDictBase) -> Tensor:
        """Return :math:`V`, ``[R]``."""
        network, params = self.value_network, self.value_network_params
        value = written_entry(network, params, states, self.tensor_keys.value)
        return value.squeeze(-1)
