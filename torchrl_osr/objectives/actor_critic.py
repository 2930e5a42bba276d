"""What OSR and OSR-v share: the terms of a soft actor-critic on D_tot, and the call.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics, ``D`` state
sets of D_tot (2: clean and perturbed; 1 where nothing recovers).
"""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import distance_loss

from torchrl_osr import functional
from torchrl_osr.objectives.distributions import check_action
from torchrl_osr.objectives.mixed_states import (
    column,
    entry,
    nested,
    reduce_transitions,
)
from torchrl_osr.objectives.networks import ActorCriticNetworks


class RecoveryActorCriticLoss(ActorCriticNetworks):
    """Abstract base of OSRLoss and OSRVLoss, which add their constraints."""

    def _actor_term(
        self, states: TensorDictBase, pi: TanhNormal
    ) -> tuple[Tensor, Tensor]:
        """Return the policy's objective and log-density on D_tot, each ``[D, B]``."""
        action, log_prob = rsample_and_log_prob(pi)
        qvalue = self._qvalue(states, action, self.qvalue_network_params.detach())
        alpha = self.log_alpha.detach().exp()
        return functional.soft_policy_value(log_prob, qvalue, alpha), log_prob

    def _alpha_term(self, log_prob: Tensor, action_dim: int) -> Tensor:
        """Return the temperature's objective, ``[D, B]``."""
        target_entropy = self.target_entropy
        if target_entropy == "auto":
            target_entropy = -float(action_dim)
        return functional.temperature_objective(
            self.log_alpha, log_prob, target_entropy
        )

    @torch.no_grad()
    def _target_value(
        self, tensordict: TensorDictBase, states: TensorDictBase, policy: TensorDictBase
    ) -> Tensor:
        """Return the TD target ``[B]`` from the states ``s'`` and the policy there."""
        action, _ = rsample_and_log_prob(self._distribution(policy))
        next_qvalue = self._qvalue(states, action, self.target_qvalue_network_params)
        column(tensordict, nested("next", self.tensor_keys.reward))
        batch = tensordict.copy()
        value_key = nested("next", self.value_estimator.tensor_keys.value)
        batch.set(value_key, next_qvalue.min(0).values.unsqueeze(-1))
        target_value: Tensor = self.value_estimator.value_estimate(batch)
        return target_value.squeeze(-1)

    def _td_term(self, qvalue: Tensor, target_value: Tensor) -> Tensor:
        """Return the sum over critics of the TD distance, ``[B]``.

        The paper prints OSR-v's TD error without the square; it is meant (equation 2).
        """
        target_value = target_value.expand_as(qvalue)
        distance: Tensor = distance_loss(qvalue, target_value, self.loss_function)
        return distance.sum(0)

    def _reduce_recovery(
        self, value: Tensor, done: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        """Return the recovery term ``[B]``, reduced as asked, and its mean."""
        weights = self._weights(tensordict)
        reduced = reduce_transitions(self, value, done, tensordict, weights)
        mean = reduce_transitions(
            self, value.detach(), done, tensordict, reduction="mean"
        )
        return reduced, mean

    @abstractmethod
    def _constraints(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        policy: TensorDictBase,
        pi: TanhNormal,
        done: Tensor,
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Return what makes one loss differ from another.

        Args:
            tensordict: the batch, ``[B]``.
            states: ``[s, s', s^]``, see :meth:`_states`.
            policy: the policy's parameters there.
            pi: the policy on D_tot, ``[D, B]``.
            done: rows whose next state is not to be learnt from, ``[B]``.

        Returns:
            The critics' values of the data's actions ``[N, B]``, further ``loss_*``
            entries, weighted and reduced, and further metrics.
        """

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and metrics of a batch, see ``out_keys``.

        Writes the largest absolute TD error of the critics under the ``priority`` key,
        ``[B]``, and nothing else, into ``tensordict``.

        Args:
            tensordict: a batch ``[B]`` with the entries of ``in_keys``.
        """
        states = self._states(tensordict)
        policy = self._policy(states)
        pi = self._distribution(policy[::2])
        action_key, action_dim = self.tensor_keys.action, pi.loc.shape[-1]
        check_action(entry(tensordict, action_key), action_dim, action_key)

        actor, log_prob = self._actor_term(states[::2], pi)
        alpha = self._alpha_term(log_prob, action_dim)
        done = self._flag(tensordict, self.tensor_keys.done)
        pred_value, losses, metrics = self._constraints(
            tensordict, states, policy, pi, done
        )
        target_value = self._target_value(tensordict, states[1], policy[1].detach())
        losses = {
            "loss_actor": self._reduce(actor.mean(0), tensordict),
            "loss_alpha": self._reduce(alpha.mean(0), tensordict),
            "loss_qvalue": self._reduce(
                self._td_term(pred_value, target_value), tensordict
            ),
        } | losses
        metrics = {
            "alpha": self.log_alpha.detach().exp(),
            "entropy": -self._mean(log_prob, tensordict),
            "pred_value": self._mean(pred_value, tensordict),
            "target_value": self._mean(target_value, tensordict),
        } | metrics
        td_error = (pred_value.detach() - target_value).abs().amax(0)
        tensordict.set(self.tensor_keys.priority, td_error)
        return self._output(tensordict, losses, metrics)
