r"""OSR for discrete actions: every expectation over the actions is a sum, not a sample.

Shapes: ``R`` rows, ``n`` number of actions, ``N`` critics, ``D`` sets of states (2 for
D_tot: clean and perturbed). The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from torchrl_osr import functional as F
from torchrl_osr._checks import check_positive
from torchrl_osr._entries import state_keys
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses, StatePolicy
from torchrl_osr.objectives.networks import check_num_actions, is_categorical
from torchrl_osr.objectives.state_recovery import at_actions
from torchrl_osr.objectives.transitions import SETS, Transitions


class DiscreteOSRLoss(ActorCriticLoss):
    r"""Out-of-sample State Recovery for a finite number of actions.

    .. math::
        L_\pi &= \mathbb E_{\tilde s \sim D_{tot}} \sum_a \pi(a \mid \tilde s)
            [\alpha_e \log\pi(a \mid \tilde s) - \min_i Q_i(\tilde s, a)]
            + \lambda\, \mathbb E_{D_{tot}}
            KL(I(a \mid \tilde s, s') \,\|\, \pi(a \mid \tilde s)) \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2 + \alpha \sum_i \mathbb E_D \Big[
            \tau \log \sum_a e^{Q_i(s, a) / \tau} - Q_i(s, a) \Big] \\
        T &= r + \gamma\,(1 - \text{terminated})
            \sum_a \pi(a \mid s') \min_i \bar Q_i(s', a)

    :class:`~torchrl_osr.OSRLoss` with the actor of discrete SAC
    (https://arxiv.org/abs/1910.07207) and the exact CQL(H) term
    (https://arxiv.org/abs/2006.04779). The paper has no such equations. With
    ``recovery_weight=0`` it is discrete CQL(H): no model, no perturbed states.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.OneHotCategorical`, and then
            reads one-hot actions ``[B, n]`` from the batch, or in a
            :class:`torch.distributions.Categorical`, and reads indices ``[B]`` or
            ``[B, 1]`` (:func:`~torchrl_osr.modules.categorical_actor`).
        qvalue_network: one critic, copied by TorchRL, or a list of critics; each writes
            ``"action_value"``, ``[B, n]``
            (:func:`~torchrl_osr.modules.discrete_critic_ensemble`).
        inverse_dynamics_network: a *trained* categorical model of ``I(a | s, s')``,
            frozen here, with the actor's mask, if any. Needed unless
            ``recovery_weight=0``.

    Keyword Args:
        recovery_weight: weight :math:`\lambda`. Default 0.5. May be assigned later; 0
            here removes the term permanently.
        min_q_weight, temperature, alpha_init: see :class:`~torchrl_osr.CQLLoss`.
        target_entropy: in nats; ``"auto"`` (default) is 0.98 times ``log(n)``, as in
            TorchRL's ``DiscreteSACLoss``: a policy that is nearly uniform.
        options: of every loss, see :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Examples:
        >>> from torchrl_osr import DiscreteOSRLoss
        >>> from torchrl_osr.modules import (
        ...     categorical_actor, categorical_inverse_dynamics,
        ...     discrete_critic_ensemble)
        >>> loss = DiscreteOSRLoss(categorical_actor(4, 2),
        ...                        discrete_critic_ensemble(4, 2),
        ...                        categorical_inverse_dynamics(4, 2))
        >>> [key for key in loss.out_keys if key.startswith("loss_")]
        ['loss_actor', 'loss_alpha', 'loss_qvalue', 'loss_cql']
    """

    _schedulable_buffers = frozenset({"recovery_weight", "min_q_weight"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        min_q_weight: float = 5.0,
        temperature: float = 1.0,
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        **options: Any,
    ) -> None:
        check_positive("temperature", temperature)
        self.reads_perturbed = self.has_recovery = recovery_weight > 0
        if self.has_recovery and inverse_dynamics_network is None:
            raise ValueError(
                f"recovery_weight={recovery_weight} needs an inverse_dynamics_network: "
                "pass one, or recovery_weight=0 for CQL."
            )
        super().__init__(**options)
        model = inverse_dynamics_network if self.has_recovery else None
        for name, network in (("actor", actor_network), ("inverse_dynamics", model)):
            if network is not None and not is_categorical(network):
                raise TypeError(
                    f"{name}_network must end in a categorical distribution, such as "
                    "OneHotCategorical: torchrl_osr.modules builds such networks. For "
                    "continuous actions use OSRLoss."
                )
        self.register_actor_critic(actor_network, qvalue_network)
        if model is not None:
            self.register_frozen("inverse_dynamics_network", model)
        self.register_temperature(alpha_init, target_entropy)
        self.register_coefficient("recovery_weight", recovery_weight)
        self.register_coefficient("min_q_weight", min_q_weight)
        self.has_cql, self.temperature = min_q_weight > 0, temperature
        self.declare_soft_actor_critic(*["recovery_kl"] * self.has_recovery)

    def losses(self, batch: Transitions) -> Losses:
        policy = self.policy(batch)
        states = "both" if self.has_recovery else "clean"
        pi = policy[states]
        qvalue = self.action_values(batch.s, self.qvalue_network_params, pi)
        q_data = at_actions(qvalue, batch.a, pi, self.tensor_keys.action)
        sought = self.action_values(batch.states[SETS[states]], self.frozen_critics, pi)
        objective = F.discrete_policy_value(pi.logits, sought, self.alpha).mean(0)
        log_prob, auto = -pi.entropy(), 0.98 * math.log(pi.logits.shape[-1])
        losses, metrics = self.soft_actor_losses(batch, objective, log_prob, auto)
        if self.has_recovery:
            model = self.inverse_dynamics(batch, "both").logits
            check_num_actions("inverse_dynamics_network", model, pi.logits)
            recovery = F.categorical_kl(model, pi.logits).mean(0)
            term = self.reduce(recovery, batch, batch.has_next)
            losses["loss_actor"] = losses["loss_actor"] + self.recovery_weight * term
            metrics["recovery_kl"] = self.mean(recovery, batch, batch.has_next)
        error, values = self.td_error(batch, q_data, self.soft_target(batch, policy))
        losses["loss_qvalue"] = self.reduce(error, batch)
        if self.has_cql:
            # Exact: each action counts once, and for certain.
            certain, tau = torch.zeros_like(qvalue), self.temperature
            soft_maximum = F.soft_maximum(qvalue, certain, temperature=tau)
            gap = F.conservative_gap(soft_maximum, q_data).sum(0)
            reduced = self.reduce(gap, batch, batch.is_data)
            losses["loss_cql"] = self.min_q_weight * reduced
        return losses, metrics | values

    def action_values(
        self, states: TensorDictBase, params: TensorDictBase, pi: Any
    ) -> Tensor:
        """Return the values of all actions, ``[N, ..., n]``; ``pi`` gives ``n``."""
        keys = state_keys(self.qvalue_network.in_keys)
        rows = states.select(*keys, strict=False).reshape(-1)
        qvalue = self.critic_output(rows, params, self.tensor_keys.action_value)
        check_num_actions("qvalue_network", qvalue, pi.logits)
        return qvalue.reshape(-1, *states.batch_size, qvalue.shape[-1])

    @torch.no_grad()
    def soft_target(self, batch: Transitions, policy: StatePolicy) -> Tensor:
        """Return the TD target in expectation over the policy at ``s'``, ``[R]``."""
        pi, params = policy["next"], self.target_qvalue_network_params
        qvalue = self.action_values(batch.states[SETS["next"]], params, pi)
        next_value = -F.discrete_policy_value(pi.logits, qvalue, 0.0)
        return self.td_target(batch, next_value.squeeze(0))
