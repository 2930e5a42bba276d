r"""OSR for discrete actions: every expectation over the actions is a sum, not a sample.

Shapes: ``B`` batch (any leading dimensions), ``n`` number of actions, ``N`` critics,
``D`` sets of states (2 for D_tot: clean and perturbed). The equations are in
:mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
)
from torch import Tensor

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.distributions import (
    action_index,
    check_categorical,
    check_num_actions,
)
from torchrl_osr.objectives.mixed_states import States
from torchrl_osr.objectives.step import (
    Step,
    actor_critic_in_keys,
    critic_inputs,
    critic_output,
)


class DiscreteOSRLoss(BaseLoss):
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
    (https://arxiv.org/abs/2006.04779). The paper has continuous actions only; this
    is its method where they are discrete, not an experiment of its authors. With
    ``recovery_weight=0, actor_states="clean"`` it is discrete CQL(H).

    ``loss_actor`` holds both terms of :math:`L_\pi`. Each entry is weighted already
    and sends gradient into its own group of parameters only.

    Args:
        actor_network: ends in a :class:`~torchrl.modules.OneHotCategorical`, and then
            reads one-hot actions ``[B, n]`` from the batch, or in a
            :class:`torch.distributions.Categorical`, and reads indices ``[B]`` or
            ``[B, 1]`` (:func:`~torchrl_osr.modules.categorical_actor`).
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights; each writes ``"action_value"``, ``[B, n]``
            (:func:`~torchrl_osr.modules.discrete_critic_ensemble`).
        inverse_dynamics_network: a *trained* categorical model of ``I(a | s, s')``, see
            :class:`~torchrl_osr.InverseDynamicsLoss`. It is frozen here. Needed unless
            ``recovery_weight=0``.

    Keyword Args:
        recovery_weight: :math:`\lambda`. Default 0.5. May be assigned later; 0 *here*
            leaves the recovery term out for good.
        min_q_weight: :math:`\alpha`, weight of the conservative term, in units of the
            value: the TD error is squared, the term is not. Default 5.0, that of
            :class:`~torchrl_osr.OSRLoss`. May be assigned later; 0 *here* leaves the
            term out for good.
        temperature: :math:`\tau`, in units of the value. Default 1.0.
        recovery_direction: ``"forward"`` (default) for ``KL(I || pi)`` or ``"reverse"``
            for ``KL(pi || I)``.
        recovery_states: where the recovery term is taken: ``"both"`` (default) for
            D_tot, ``"perturbed"`` or ``"clean"`` states alone.
        actor_states: where the policy seeks values, whatever the recovery term does:
            ``"both"`` (default), ``"clean"`` or ``"perturbed"``.
        alpha_init: initial entropy temperature :math:`\alpha_e`. Default 1.0.
        fixed_alpha: keep the temperature. Default ``False``.
        target_entropy: in nats; ``"auto"`` (default) is ``target_entropy_weight`` times
            the entropy of the uniform policy, ``log(n)``.
        target_entropy_weight: Default 0.98, TorchRL's in ``DiscreteSACLoss``: a policy
            that is nearly uniform.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        TypeError: if a distribution is not categorical.
        ValueError: if an option is out of its range or the model is missing; in the
            call, if the networks' numbers of actions or the batch's actions do not
            match, or the batch is empty or holds several steps a row.
        KeyError: in the call, if the batch has no perturbed entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import DiscreteOSRLoss, StatePerturbation
        >>> from torchrl_osr.modules import (
        ...     categorical_actor, categorical_inverse_dynamics,
        ...     discrete_critic_ensemble)
        >>> loss = DiscreteOSRLoss(categorical_actor(4, 2),
        ...                        discrete_critic_ensemble(4, 2),
        ...                        categorical_inverse_dynamics(4, 2))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(3, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(3, 4), "action": torch.eye(2)[[0, 1, 0]],
        ...     "next": {"observation": torch.randn(3, 4), "reward": torch.ones(3, 1),
        ...              "done": no, "terminated": no}}, [3])
        >>> losses = loss(StatePerturbation(std=1e-3)(batch))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_cql', 'loss_qvalue']
    """

    _schedulable_buffers = frozenset({"recovery_weight", "min_q_weight"})

    @dataclass
    class _AcceptedKeys(TransitionKeys):
        """The tensordict entries that :meth:`set_keys` can rename.

        Attributes:
            action_value: what a critic writes. Defaults to ``"action_value"``.
        """

        action_value: NestedKey = "action_value"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        inverse_dynamics_network: ProbabilisticTensorDictSequential | None = None,
        *,
        recovery_weight: float = 0.5,
        min_q_weight: float = 5.0,
        temperature: float = 1.0,
        recovery_direction: Literal["forward", "reverse"] = "forward",
        recovery_states: States = "both",
        actor_states: States = "both",
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | Literal["auto"] = "auto",
        target_entropy_weight: float = 0.98,
        **options: Any,
    ) -> None:
        check_literals(DiscreteOSRLoss.__init__, locals())
        check_weight("recovery_weight", recovery_weight)
        check_weight("min_q_weight", min_q_weight)
        check_positive("temperature", temperature)
        if recovery_weight and inverse_dynamics_network is None:
            raise ValueError(
                f"recovery_weight={recovery_weight} needs an inverse_dynamics_network; "
                "pass one, or recovery_weight=0 for CQL."
            )
        super().__init__(**options)
        check_categorical(actor_network, "actor_network")
        model = inverse_dynamics_network if recovery_weight else None
        if model is not None:
            check_categorical(model, "inverse_dynamics_network")
        self._hold_actor_critic(
            actor_network,
            qvalue_network,
            inverse_dynamics_network=model,
        )
        self._hold_temperature(alpha_init, fixed_alpha, target_entropy)
        self.register_coeff_buffer("recovery_weight", float(recovery_weight))
        self.register_coeff_buffer("min_q_weight", float(min_q_weight))
        self.has_recovery, self.has_cql = recovery_weight > 0, min_q_weight > 0
        self.temperature = temperature
        self.recovery_direction = recovery_direction
        self.recovery_states = recovery_states
        self.actor_states = actor_states
        self.target_entropy_weight = target_entropy_weight
        self.make_value_estimator()

    @property
    def reads_perturbed(self) -> bool:
        """Whether the batch must hold perturbed states."""
        recovers = self.has_recovery and self.recovery_states != "clean"
        return recovers or self.actor_states != "clean"

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=self.reads_perturbed)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        losses: list[NestedKey] = ["loss_actor", "loss_alpha", "loss_qvalue"]
        losses += ["loss_cql"] * self.has_cql
        metrics: list[NestedKey] = ["alpha", "entropy", "pred_value", "target_value"]
        return losses, metrics + ["recovery_kl"] * self.has_recovery

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=self.reads_perturbed)
        pi = step.policy(self.actor_states)
        qvalue, pred_value = self._data_qvalue(step, pi)
        actor, metrics = self.actor_loss(step, pi)
        target_value = self._target_value(step)
        step.write_priority(pred_value, target_value)
        losses = {
            "loss_actor": actor,
            "loss_alpha": self.alpha_loss(step, pi),
            "loss_qvalue": step.reduce(step.td_distance(pred_value, target_value)),
        }
        if self.has_cql:
            losses["loss_cql"] = self.cql_loss(step, qvalue, pred_value)
        metrics = {
            "alpha": self._alpha,
            "entropy": step.mean(pi.entropy()),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
            **metrics,
        }
        return losses, metrics

    def _action_values(
        self, states: TensorDictBase, params: TensorDictParams, pi: Any
    ) -> Tensor:
        """The values of all actions, ``[N, ..., n]``; ``pi`` tells ``n``."""
        if self.tensor_keys.action in self.qvalue_network.in_keys:
            raise ValueError(
                f"The critics read {self.tensor_keys.action!r}: for discrete actions a "
                "critic reads the state alone and values every action, see "
                "torchrl_osr.modules.discrete_critic_ensemble."
            )
        batch, key = critic_inputs(self, states), self.tensor_keys.action_value
        qvalue = critic_output(self, batch, params, key)
        check_num_actions("qvalue_network", qvalue.shape[-1], pi.logits.shape[-1])
        return qvalue

    def _data_qvalue(self, step: Step, pi: Any) -> tuple[Tensor, Tensor]:
        """Values at ``s`` of all actions, ``[N, B, n]``, and the data's, ``[N, B]``."""
        key, batch_size = self.tensor_keys.action, step.tensordict.batch_size
        index = action_index(step.data_action, pi, batch_size, key)
        qvalue = self._action_values(step.states[0], self.qvalue_network_params, pi)
        index = index.expand(qvalue.shape[:-1]).unsqueeze(-1)
        return qvalue, qvalue.gather(-1, index).squeeze(-1)

    def actor_loss(self, step: Step, pi: Any) -> tuple[Tensor, dict[str, Tensor]]:
        r""":math:`L_\pi`: values sought on ``actor_states``, and the recovery term."""
        # Detached: the policy's objective shall not train the critics.
        params = self.qvalue_network_params.detach()
        qvalue = self._action_values(step.at(self.actor_states), params, pi)
        alpha = self._alpha
        objective = functional.discrete_policy_value(pi.logits, qvalue, alpha)
        loss = step.reduce(objective.mean(0))
        if not self.has_recovery:
            return loss, {}
        recovery = self._recovery_divergence(step).mean(0)
        term = step.reduce(recovery, transitions=True)
        metrics = {"recovery_kl": step.mean(recovery, transitions=True)}
        return loss + self.recovery_weight * term, metrics

    def _recovery_divergence(self, step: Step) -> Tensor:
        """Divergence of policy and model on ``recovery_states``, ``[D, B]``."""
        policy = step.policy(self.recovery_states).logits
        model = step.inverse_dynamics(self.recovery_states).logits
        sizes = model.shape[-1], policy.shape[-1]
        check_num_actions("inverse_dynamics_network", *sizes)
        if self.recovery_direction == "forward":
            return functional.categorical_kl(model, policy)
        return functional.categorical_kl(policy, model)

    def alpha_loss(self, step: Step, pi: Any) -> Tensor:
        """SAC's objective of the entropy temperature."""
        auto = self.target_entropy_weight * math.log(pi.logits.shape[-1])
        return step.temperature_loss(-pi.entropy(), auto=auto)

    def cql_loss(self, step: Step, qvalue: Tensor, pred_value: Tensor) -> Tensor:
        """CQL(H) penalty, exact: each action once, and for certain."""
        certain = torch.zeros_like(qvalue)
        soft_maximum = functional.soft_maximum(
            qvalue, certain, temperature=self.temperature
        )
        gap = functional.conservative_gap(soft_maximum, pred_value)
        loss: Tensor = self.min_q_weight * step.reduce(gap.sum(0))
        return loss

    @torch.no_grad()
    def _target_value(self, step: Step) -> Tensor:
        """The TD target, ``[B]``, in expectation over the policy at ``s'``."""
        pi, params = step.policy("next"), self.target_qvalue_network_params
        qvalue = self._action_values(step.at("next"), params, pi)
        next_value = -functional.discrete_policy_value(pi.logits, qvalue, 0.0)
        return step.td_target(next_value.squeeze(0))
