"""What all recovery losses share: the terms of a soft actor-critic, and the call.

Shapes: ``B`` batch (any leading dimensions), ``N`` critics, ``D`` state sets of D_tot
(2: clean and perturbed; 1 where nothing recovers, or where one set was asked for).
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import distance_loss

from torchrl_osr import functional
from torchrl_osr.objectives.mixed_states import (
    column,
    nested,
    reduce_transitions,
)
from torchrl_osr.objectives.networks import ActorCriticNetworks


class RecoveryActorCriticLoss(ActorCriticNetworks):
    """Abstract base: the losses differ in their actions and in their constraints."""

    def _before(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the batch that the terms are computed from; it may be another one."""
        return tensordict

    @abstractmethod
    def _data_action(self, tensordict: TensorDictBase, pi: Any) -> Tensor:
        """Return the data's actions, or say what is wrong with them."""

    @abstractmethod
    def _actor_term(
        self, states: TensorDictBase, pi: Any, data_action: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the policy's objective and its negative entropy, each ``[D, B]``.

        Args:
            states: ``[D, B]``.
            pi: the policy there.
            data_action: the batch's actions.
        """

    @abstractmethod
    def _next_value(self, states: TensorDictBase, pi: Any) -> Tensor:
        """Return the target critics' value of ``s'`` under the policy, ``[B]``."""

    @abstractmethod
    def _constraints(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        pi: Any,
        data_action: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Return what makes one loss differ from another.

        Args:
            tensordict: the batch, ``[B]``.
            states: ``[s, s', s^]``, see :meth:`_states`.
            policy: the policy's parameters there.
            pi: the policy on the actor's rows of them.
            data_action: the batch's actions.

        Returns:
            The critics' values of the data's actions ``[N, B]``, further ``loss_*``
            entries, weighted and reduced, and further metrics.
        """

    @abstractmethod
    def _auto_target_entropy(self, pi: Any) -> float:
        """Return what ``target_entropy="auto"`` stands for, in nats."""

    def _alpha_term(self, log_prob: Tensor, pi: Any) -> Tensor:
        """Return the temperature's objective, ``[D, B]``."""
        target_entropy = self.target_entropy
        if target_entropy == "auto":
            target_entropy = self._auto_target_entropy(pi)
        return functional.temperature_objective(
            self.log_alpha, log_prob, target_entropy
        )

    def _target_value(
        self, tensordict: TensorDictBase, states: TensorDictBase, policy: TensorDictBase
    ) -> Tensor:
        """Return the TD target ``[B]`` from the states ``s'`` and the policy there."""
        next_value = self._next_value(states, self._distribution(policy))
        for key in (self.tensor_keys.reward, self.tensor_keys.done):
            column(tensordict, nested("next", key))
        batch = tensordict.copy()
        value_key = nested("next", self.value_estimator.tensor_keys.value)
        batch.set(value_key, next_value.unsqueeze(-1))
        target_value: Tensor = self.value_estimator.value_estimate(batch)
        return target_value.squeeze(-1)

    def _td_term(self, qvalue: Tensor, target_value: Tensor) -> Tensor:
        """Return the sum over critics of the TD distance, ``[B]``.

        The paper prints OSR-v's TD error without the square; it is meant (equation 2).
        """
        target_value = target_value.expand_as(qvalue)
        distance: Tensor = distance_loss(qvalue, target_value, self.loss_function)
        return distance.sum(0)

    def _recovery_policy(self, policy: TensorDictBase, pi: Any) -> Any:
        """Return the policy where it is to recover: on D_tot, or at ``s^`` alone."""
        rows = slice(2, 3) if self.recovery_states == "perturbed" else slice(0, None, 2)
        # One object for both terms where it is the same: no work done twice.
        return pi if rows == self._actor_rows else self._distribution(policy[rows])

    def _reduce_recovery(
        self, value: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        """Return the recovery term ``[D, B]``, reduced as asked, and its mean."""
        done = self._flag(tensordict, self.tensor_keys.done)
        weights, value = self._weights(tensordict), value.mean(0)
        reduced = reduce_transitions(self, value, done, tensordict, weights)
        mean = reduce_transitions(
            self, value.detach(), done, tensordict, reduction="mean"
        )
        return reduced, mean

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and metrics of a batch, see ``out_keys``.

        Writes the largest absolute TD error of the critics under the ``priority`` key,
        ``[B]``, and nothing else, into ``tensordict``.

        Args:
            tensordict: a batch ``[B]`` with the entries of ``in_keys``.
        """
        batch = self._before(tensordict)
        states = self._states(batch)
        policy = self._policy(states)
        pi = self._distribution(policy[self._actor_rows])
        data_action = self._data_action(batch, pi)

        actor, log_prob = self._actor_term(states[self._actor_rows], pi, data_action)
        alpha = self._alpha_term(log_prob, pi)
        pred_value, losses, metrics = self._constraints(
            batch, states, policy, pi, data_action
        )
        target_value = self._target_value(batch, states[1], policy[1].detach())
        losses = {
            "loss_actor": self._reduce(actor.mean(0), batch),
            "loss_alpha": self._reduce(alpha.mean(0), batch),
            "loss_qvalue": self._reduce(self._td_term(pred_value, target_value), batch),
        } | losses
        metrics = {
            "alpha": self.log_alpha.detach().exp(),
            "entropy": -self._mean(log_prob, batch),
            "pred_value": self._mean(pred_value, batch),
            "target_value": self._mean(target_value, batch),
        } | metrics
        td_error = (pred_value.detach() - target_value).abs().amax(0)
        tensordict.set(self.tensor_keys.priority, td_error)
        return self._output(batch, losses, metrics)
