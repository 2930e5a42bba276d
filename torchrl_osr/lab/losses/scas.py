r"""SCAS: a dynamics model says which action leads back to the data.

Shapes: ``B`` batch (any leading dimensions), ``S`` observation, ``A`` action, ``N``
critics. The equations are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr._entries import entry, nested, select
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.losses.correction import correction_error, value_gain_weight
from torchrl_osr.lab.losses.td3_bc import check_smoothing, smoothed_action_and_value
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.distributions import check_action
from torchrl_osr.objectives.mixed_states import check_single_steps, next_state
from torchrl_osr.objectives.step import Step, actor_critic_in_keys, observation_keys


class SCASLoss(BaseLoss):
    r"""Offline RL with state correction (SCAS), on TD3.

    .. math::
        L_\pi &= (1 - \lambda)\,\mathbb E_D \Big[
            - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|} \Big]
            + \lambda\,\mathbb E_D \Big[
            w(s, s')\,\frac1S \big\| M(\hat s, \pi(\tilde s)) - s' \big\|^2 \Big]
            \\
        w(s, s') &= \min\big(e^{\tau (V(s') - V(s))}, w_{max}\big), \quad
        V(s) = \frac1N \sum_i Q_i(s, \pi(s))

    with a perturbed state :math:`\hat s` and a frozen model :math:`M` of the dynamics.
    The critics' loss is TD3's. Presented in "Offline Reinforcement Learning with OOD
    State Correction and OOD Action Suppression", https://arxiv.org/abs/2410.19400. It
    prints :math:`\tilde s = \hat s`; its released code (MAOYIXIU/SCAS) has
    :math:`\tilde s = s`, the default here. The authors update policy and targets every
    second step, which is the training loop's to do.

    Differences from that code: :math:`M` is the mean of an ensemble's elites, which
    predicts the state's change by likelihood (there one network, the next state by its
    squared error); rows that are ``done`` have no correction; the actor's rate stays as
    it is (there it falls by a cosine); the target is the critics' minimum in mazes, too
    (there their mean).

    Args:
        actor_network: writes the action; see
            :func:`~torchrl_osr.modules.deterministic_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights. The authors have four.
        dynamics_network: :math:`M`; trained before, or given by :meth:`load_network`.

    Keyword Args:
        correction_weight: :math:`\lambda`, between 0 and 1. Default 0.25.
        correction_action: state :math:`\tilde s` of the action that is corrected:
            ``"clean"`` (default) as released, ``"perturbed"`` as printed.
        gain_temperature: :math:`\tau`. Default 5; with 0 all weights are 1.
        largest_weight: :math:`w_{max}`. Default 50.
        policy_noise: standard deviation of the target action's noise, in units of the
            action. Default 0.2.
        noise_clip: its largest magnitude. Default 0.5.
        low, high: action bounds, between which the target's action is kept; those of
            the actor's :class:`~torchrl.modules.TanhDelta`, if it ends in one. Default
            -1 and 1.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        ValueError: if an option is out of its range; in the call, if the batch is
            empty, or holds multi-step transitions without their single steps.
        KeyError: in the call, if the batch has no perturbed states.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr import StatePerturbation
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble
        >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
        >>> from torchrl_osr.lab.losses import SCASLoss
        >>> loss = SCASLoss(
        ...     deterministic_actor(11, 3), critic_ensemble(11, 3, num_qvalue_nets=4),
        ...     DynamicsEnsemble(11, 3))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
        >>> losses = loss(StatePerturbation(std=3e-3)(batch))
        >>> sorted(losses.keys())
        ['correction_error', 'loss_actor', 'loss_qvalue', 'pred_value', 'target_value']
    """

    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams

    _AcceptedKeys = TransitionKeys
    default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        dynamics_network: DynamicsEnsemble,
        *,
        correction_weight: float = 0.25,
        correction_action: Literal["clean", "perturbed"] = "clean",
        gain_temperature: float = 5.0,
        largest_weight: float = 50.0,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        low: float = -1.0,
        high: float = 1.0,
        **options: Any,
    ) -> None:
        check_literals(SCASLoss.__init__, locals())
        check_weight("correction_weight", correction_weight)
        if correction_weight > 1:
            raise ValueError(
                f"correction_weight must be at most 1, got {correction_weight}."
            )
        check_weight("gain_temperature", gain_temperature)
        check_positive("largest_weight", largest_weight)
        check_smoothing(policy_noise, noise_clip, low, high, actor_network)
        super().__init__(**options)
        self._hold_actor_critic(
            actor_network, qvalue_network, delay_actor=self.delay_qvalue
        )
        self._hold_frozen("dynamics_network", dynamics_network)
        self.correction_weight = correction_weight
        self.correction_action = correction_action
        self.gain_temperature, self.largest_weight = gain_temperature, largest_weight
        self.policy_noise, self.noise_clip = policy_noise, noise_clip
        self.low, self.high = low, high
        self.make_value_estimator()

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=True)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        metrics = ["correction_error", "pred_value", "target_value"]
        return ["loss_actor", "loss_qvalue"], metrics

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=True)
        actor, error = self.actor_loss(step)
        params = self.qvalue_network_params
        pred_value = step.qvalue(step.states[0], step.data_action, params)
        target_value = self._target_value(step)
        distance = step.td_distance(pred_value, target_value)
        step.write_priority(pred_value, target_value)
        metrics = {
            "correction_error": step.mean(error, transitions=True),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
        }
        losses = {"loss_actor": actor, "loss_qvalue": step.reduce(distance)}
        return losses, metrics

    def actor_loss(self, step: Step) -> tuple[Tensor, Tensor]:
        r""":math:`L_\pi`, and the weighted error of the correction, ``[B]``."""
        clean, _, perturbed = step.states.unbind(0)
        action = step.action(clean, self.actor_network_params)
        check_action(step.data_action, action.shape[-1], self.tensor_keys.action)
        # Detached: the policy's objective shall not train the critics.
        params = self.qvalue_network_params.detach()
        qvalues = step.qvalue(clean, action, params)
        qvalue = qvalues.min(0).values
        magnitude = step.magnitude(qvalue)
        weight = self._weight(step, qvalues.detach().mean(0))
        if self.correction_action == "perturbed":
            action = step.action(perturbed, self.actor_network_params)
        error = correction_error(
            self._next_state(perturbed, action), self._data_next_state(step), weight
        )
        share = self.correction_weight
        sought = (1 - share) * step.reduce(-qvalue / magnitude)
        return sought + share * step.reduce(error, transitions=True), error

    @torch.no_grad()
    def _weight(self, step: Step, value: Tensor) -> Tensor:
        """Weight of each row's correction, ``[B]``, from the value of its state."""
        # Of single steps, as the correction: not step.states[1].
        keys = observation_keys(self)
        after = select(step.first, keys)
        for key in keys:
            after.set(key, next_state(step.first, key, step.done))
        action = step.action(after, self.actor_network_params)
        next_value = step.qvalue(after, action, self.qvalue_network_params).mean(0)
        return value_gain_weight(
            value,
            next_value,
            temperature=self.gain_temperature,
            largest=self.largest_weight,
        )

    def _next_state(self, states: TensorDictBase, action: Tensor) -> Tensor:
        """Where the elites' mean says that an action leads, ``[B, S]``."""
        model = self.dynamics_network
        with self.dynamics_network_params.to_module(model, preserve_module_state=False):
            state = entry(states, model.in_keys[0])
            mean, _ = model.predict(state, action)
            return state + mean[model.elites].mean(0)[..., :-1]

    def _data_next_state(self, step: Step) -> Tensor:
        check_single_steps(step.first, "the model of the dynamics")
        key = nested("next", self.dynamics_network.in_keys[0])
        found = entry(step.first, key)
        # What follows an end may be anything, and 0 * nan is nan in the backward pass.
        return torch.where(step.done.unsqueeze(-1), torch.zeros_like(found), found)

    @torch.no_grad()
    def _target_value(self, step: Step) -> Tensor:
        """The TD target, ``[B]``: smoothed, with the critics' smallest value."""
        _, next_value = smoothed_action_and_value(self, step)
        return step.td_target(next_value)
