"""The terms that need finitely many actions: a categorical policy and Q(s, .).

Shapes: ``B`` batch (any leading dimensions), ``n`` number of actions, ``N`` critics,
``D`` state sets of D_tot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from torch import Tensor

from torchrl_osr import functional
from torchrl_osr.objectives.actor_critic import RecoveryActorCriticLoss
from torchrl_osr.objectives.distributions import (
    action_index,
    check_categorical,
    check_num_actions,
    check_same_size,
)
from torchrl_osr.objectives.mixed_states import entry
from torchrl_osr.objectives.networks import ActorCriticNetworks


class CategoricalActorCritic(RecoveryActorCriticLoss):
    """Abstract base of DiscreteOSRLoss, which adds its constraints."""

    @dataclass
    class _AcceptedKeys(ActorCriticNetworks._AcceptedKeys):
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action: the data's action. Defaults to ``"action"``.
            action_value: what a critic writes. Defaults to ``"action_value"``.
            value: what the value estimator reads. Defaults to ``"state_value"``.
            reward, done, terminated: below ``"next"``. Default to their own names.
            priority: written to the batch, ``[B]``. Defaults to ``"td_error"``.
            priority_weight: importance weight of a row. Defaults to
                ``"priority_weight"``.
            perturbed: where the perturbed twins are. Defaults to ``"perturbed"``.
        """

        action_value: NestedKey = "action_value"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self, *networks: Any, target_entropy_weight: float, **options: Any
    ) -> None:
        super().__init__(*networks, **options)
        self.target_entropy_weight = target_entropy_weight

    def _check_distributions(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None,
    ) -> None:
        check_categorical(actor_network, "actor_network")
        if inverse_dynamics_network is not None:
            check_categorical(inverse_dynamics_network, "inverse_dynamics_network")
            check_same_size(actor_network, inverse_dynamics_network)

    def _data_action(self, tensordict: TensorDictBase, pi: Any) -> Tensor:
        key = self.tensor_keys.action
        return action_index(entry(tensordict, key), pi, tensordict.batch_size, key)

    def _action_values(
        self, states: TensorDictBase, params: TensorDictParams, pi: Any
    ) -> Tensor:
        """Return the values of all actions, ``[N, B, n]``; ``pi`` tells ``n``."""
        if self.tensor_keys.action in self.qvalue_network.in_keys:
            raise ValueError(
                f"The critics read {self.tensor_keys.action!r}: for discrete actions a "
                "critic reads the state alone and values every action, see "
                "torchrl_osr.modules.discrete_critic_ensemble."
            )
        batch = self._critic_inputs(states)
        qvalue = self._critics(batch, params, self.tensor_keys.action_value)
        check_num_actions("qvalue_network", qvalue.shape[-1], pi.logits.shape[-1])
        return qvalue

    def _actor_term(
        self, states: TensorDictBase, pi: Any, data_action: Tensor
    ) -> tuple[Tensor, Tensor]:
        qvalue = self._action_values(states, self.qvalue_network_params.detach(), pi)
        alpha = self.log_alpha.detach().exp()
        value = functional.discrete_policy_value(pi.logits, qvalue, alpha)
        return value, -pi.entropy()

    def _auto_target_entropy(self, pi: Any) -> float:
        return self.target_entropy_weight * math.log(pi.logits.shape[-1])

    @torch.no_grad()
    def _next_value(self, states: TensorDictBase, pi: Any) -> Tensor:
        qvalue = self._action_values(states, self.target_qvalue_network_params, pi)
        return -functional.discrete_policy_value(pi.logits, qvalue, 0.0)
