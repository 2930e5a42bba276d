"""The terms that need a continuous action: a tanh-Gaussian policy and Q(s, a).

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``D`` state
sets of D_tot, ``K`` sampled actions of a kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_osr import functional
from torchrl_osr.objectives import mlp_critics
from torchrl_osr.objectives.actor_critic import RecoveryActorCriticLoss
from torchrl_osr.objectives.adversary import Adversary
from torchrl_osr.objectives.distributions import (
    action_bounds,
    check_action,
    check_num_actions,
    check_same_bounds,
    check_same_size,
)
from torchrl_osr.objectives.mixed_states import entry, nested, select
from torchrl_osr.objectives.mlp_layers import PlainMLP, plain_mlp
from torchrl_osr.objectives.networks import ActorCriticNetworks


class TanhGaussianActorCritic(RecoveryActorCriticLoss):
    """Abstract base of OSRLoss and OSRVLoss, which add their constraints."""

    @dataclass
    class _AcceptedKeys(ActorCriticNetworks._AcceptedKeys):
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action: the data's action. Defaults to ``"action"``.
            state_action_value: what a critic writes. Defaults to
                ``"state_action_value"``.
            value: what the value estimator reads. Defaults to ``"state_value"``.
            reward, done, terminated: below ``"next"``. Default to their own names.
            priority: written to the batch, ``[B]``. Defaults to ``"td_error"``.
            priority_weight: importance weight of a row. Defaults to
                ``"priority_weight"``.
            perturbed: where the perturbed twins are. Defaults to ``"perturbed"``.
        """

        state_action_value: NestedKey = "state_action_value"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        *networks: Any,
        num_random: int,
        temperature: float,
        adversary: Adversary | None,
        behavior_cloning: bool,
        **options: Any,
    ) -> None:
        if num_random < 1 or not temperature > 0:
            raise ValueError(
                "num_random must be at least 1 and temperature above 0, got "
                f"{num_random} and {temperature}."
            )
        super().__init__(*networks, **options)
        self.num_random = num_random
        self.temperature = temperature
        self.behavior_cloning = behavior_cloning
        self.adversary = adversary if self.perturbs else None

    def _check_distributions(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None,
    ) -> None:
        low, high = bounds = action_bounds(actor_network, "actor_network")
        self.register_buffer("action_low", low, persistent=False)
        self.register_buffer("action_high", high, persistent=False)
        if inverse_dynamics_network is not None:
            name = "inverse_dynamics_network"
            check_same_bounds(bounds, action_bounds(inverse_dynamics_network, name))
            check_same_size(actor_network, inverse_dynamics_network)

    def _perturbed_keys(self) -> list[NestedKey]:
        keys = super()._perturbed_keys()
        if self.adversary is None:
            return keys
        found = self._observation_keys()
        return [key for key in keys if key not in found]

    def _before(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Let the adversary, if there is one, write the perturbed twins."""
        if self.adversary is None:
            return tensordict
        keys = self._observation_keys()
        params = self.qvalue_network_params.detach()
        twin = self.adversary.perturb(
            select(tensordict, keys),
            keys,
            lambda states: self._distribution(self._policy(states)),
            lambda states, action: self._qvalue(states, action, params),
        )
        tensordict = tensordict.copy()
        for key in keys:
            tensordict.set(nested(self.tensor_keys.perturbed, key), twin.get(key))
        return tensordict

    def _data_action(self, tensordict: TensorDictBase, pi: TanhNormal) -> Tensor:
        key = self.tensor_keys.action
        action = entry(tensordict, key)
        check_action(action, pi.loc.shape[-1], key)
        return action

    def _inverse_dynamics(self, tensordict: TensorDictBase, done: Tensor) -> TanhNormal:
        model: TanhNormal = super()._inverse_dynamics(tensordict, done)
        size = tensordict.get(self.tensor_keys.action).shape[-1]
        check_num_actions("inverse_dynamics_network", model.loc.shape[-1], size)
        return model

    def _plain_critics(self) -> PlainMLP | None:
        """Return the critics' layers, if they are plain MLPs."""
        keys, network = self.tensor_keys, self.qvalue_network
        if keys.state_action_value not in network.out_keys:
            return None
        return plain_mlp(network, keys.action)

    def _critic_state(self, states: TensorDictBase) -> Tensor:
        """Return what plain critics read besides the action, ``[B, S]``."""
        keys = self.qvalue_network.in_keys[:-1]
        return torch.cat([states.get(key) for key in keys], -1)

    def _qvalue(
        self, states: TensorDictBase, action: Tensor, params: TensorDictParams
    ) -> Tensor:
        """Return the values of all critics, ``[N, B]``, at states and actions."""
        mlp = self._plain_critics()
        if mlp is not None:
            return mlp_critics.qvalue(params, mlp, self._critic_state(states), action)
        batch = self._critic_inputs(states)
        batch.set(self.tensor_keys.action, action)
        key = self.tensor_keys.state_action_value
        return self._critics(batch, params, key).squeeze(-1)

    def _actor_term(
        self, states: TensorDictBase, pi: TanhNormal, data_action: Tensor
    ) -> tuple[Tensor, Tensor]:
        action, log_prob = rsample_and_log_prob(pi)
        alpha = self.log_alpha.detach().exp()
        if self.behavior_cloning:
            # At the clean states, whose actions they are; CORL's CQL within bc_steps.
            data_log_prob = pi.log_prob(data_action.expand_as(pi.loc))[:1]
            return alpha * log_prob - data_log_prob, log_prob
        qvalue = self._qvalue(states, action, self.qvalue_network_params.detach())
        return functional.soft_policy_value(log_prob, qvalue, alpha), log_prob

    def _auto_target_entropy(self, pi: TanhNormal) -> float:
        return -float(pi.loc.shape[-1])

    @torch.no_grad()
    def _next_value(self, states: TensorDictBase, pi: TanhNormal) -> Tensor:
        action, _ = rsample_and_log_prob(pi)
        params = self.target_qvalue_network_params
        return self._qvalue(states, action, params).min(0).values

    def _uniform(self, number: int, like: Tensor) -> tuple[Tensor, Tensor]:
        """Draw ``number`` uniform actions for each row.

        Args:
            number: of actions, ``K``.
            like: an action, ``[B, A]``.

        Returns:
            Actions ``[K, B, A]`` and their log-densities ``[K, B]``.
        """
        width = (self.action_high - self.action_low).expand(like.shape[-1])
        action = torch.rand((number, *like.shape), dtype=like.dtype, device=like.device)
        log_density = -width.log().sum().expand(action.shape[:-1])
        return action * width + self.action_low, log_density
