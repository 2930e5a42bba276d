r"""SCAS: TD3, and actions that a model of the dynamics takes back to the data.

Shapes: ``R`` rows, ``S`` observation, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_osr._checks import check_positive, check_weight
from torchrl_osr._entries import entry, nested
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.losses.td3 import (
    TargetPolicySmoothing,
    magnitude,
    register_td3,
)
from torchrl_osr.objectives.actor_critic import ActorCriticLoss, Losses
from torchrl_osr.objectives.transitions import (
    Transitions,
    check_single_steps,
    next_states,
)


def value_gain_weight(
    value: Tensor, next_value: Tensor, *, temperature: float, largest: float
) -> Tensor:
    r"""Weight of a transition by how much the value rises along it.

    .. math::
        \min\big( e^{\tau\,(V(s') - V(s))},\, w_{max} \big)

    Args:
        value, next_value: of the state and of the next one, ``[R]``.
        temperature: :math:`\tau`; with 0 every transition counts alike.
        largest: :math:`w_{max}`.

    Returns:
        ``[R]``.

    Examples:
        >>> values = torch.tensor([1.0, 1.0]), torch.tensor([0.8, 9.0])
        >>> value_gain_weight(*values, temperature=5.0, largest=50.0)
        tensor([ 0.3679, 50.0000])
    """
    return (temperature * (next_value - value)).exp().clamp(max=largest)


class SCASLoss(ActorCriticLoss):
    r"""State Correction and OOD Action Suppression (SCAS).

    .. math::
        L_\pi &= (1 - \lambda)\,\mathbb E_D \Big[
            - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|} \Big]
            + \lambda\,\mathbb E_D \Big[
            w(s, s')\,\frac1S \big\| M(\hat s, \pi(\tilde s)) - s' \big\|^2 \Big]
            \\
        w(s, s') &= \min\big(e^{\tau (V(s') - V(s))}, w_{max}\big), \quad
        V(s) = \frac1N \sum_i Q_i(s, \pi(s))

    with a perturbed state :math:`\hat s` and a frozen model :math:`M` of the dynamics.
    The critics' loss is TD3's. "Offline Reinforcement Learning with OOD State
    Correction and OOD Action Suppression", https://arxiv.org/abs/2410.19400. It prints
    :math:`\tilde s = \hat s`; its released code (MAOYIXIU/SCAS) has
    :math:`\tilde s = s`, the default here. The authors update policy and targets every
    second step; that is the training loop's part.

    Differences from that code: :math:`M` is the mean of an ensemble's elites, which
    predicts the state's change by likelihood (there one network, the next state by its
    squared error); rows that are ``done`` have no correction; the target is the
    critics' minimum in mazes, too (there their mean).

    Args:
        actor_network: writes the action; see
            :func:`~torchrl_osr.modules.deterministic_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics. The authors
            have four.
        dynamics_network: :math:`M`, trained, or loaded later by :meth:`load_frozen`.

    Keyword Args:
        correction_weight: :math:`\lambda`, between 0 and 1. Default 0.25.
        correction_action: the state :math:`\tilde s` of the corrected action:
            ``"clean"`` (default) or ``"perturbed"``.
        gain_temperature: :math:`\tau`. Default 5.0.
        largest_weight: :math:`w_{max}`. Default 50.0.
        policy_noise: standard deviation of the target's noise, in units of the action.
            Default 0.2.
        noise_clip: its largest magnitude. Default 0.5.
        low, high: action bounds, numbers or ``[A]``; needed unless the actor ends in a
            :class:`~torchrl.modules.TanhDelta`, which has them.
        options: of every loss, see
            :class:`~torchrl_osr.objectives.ActorCriticLoss`.

    Raises:
        ValueError: if bounds are missing, or a number is out of its range.
        KeyError: in the call, if the batch has no perturbed states.

    Examples:
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble
        >>> from torchrl_osr.lab.losses import SCASLoss
        >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
        >>> loss = SCASLoss(
        ...     deterministic_actor(11, 3), critic_ensemble(11, 3, num_qvalue_nets=4),
        ...     DynamicsEnsemble(11, 3))
        >>> loss.out_keys
        ['loss_actor', 'loss_qvalue', 'correction_error', 'pred_value', 'target_value']
    """

    reads_perturbed = True
    dynamics_network: DynamicsEnsemble
    dynamics_network_params: TensorDictParams
    target_dynamics_network_params: TensorDictParams

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
        low: Any = None,
        high: Any = None,
        **options: Any,
    ) -> None:
        check_weight("correction_weight", correction_weight)
        check_weight("1 - correction_weight", 1 - correction_weight)
        check_weight("gain_temperature", gain_temperature)
        check_positive("largest_weight", largest_weight)
        super().__init__(**options)
        self.smoothing = TargetPolicySmoothing(policy_noise, noise_clip)
        register_td3(self, actor_network, qvalue_network, low, high)
        self.register_frozen("dynamics_network", dynamics_network)
        self.correction_weight = correction_weight
        self.correction_action = correction_action
        self.gain_temperature, self.largest_weight = gain_temperature, largest_weight
        metrics = ["correction_error", "pred_value", "target_value"]
        self.declare(["loss_actor", "loss_qvalue"], metrics)

    def losses(self, batch: Transitions) -> Losses:
        actor, correction = self.actor_loss(batch)
        q_data = self.q(batch.s, batch.a)
        with torch.no_grad():
            _, next_value = self.smoothing(self, batch)
            target = self.td_target(batch, next_value)
        error, metrics = self.td_error(batch, q_data, target)
        metrics["correction_error"] = self.mean(correction, batch, batch.has_next)
        return {"loss_actor": actor, "loss_qvalue": self.reduce(error, batch)}, metrics

    def actor_loss(self, batch: Transitions) -> tuple[Tensor, Tensor]:
        r"""Return :math:`L_\pi` and the weighted error of the correction, ``[R]``."""
        clean, _, perturbed = batch.states.unbind(0)
        action = self.act(clean, self.actor_network_params)
        self.check_actions(batch, action.shape)
        # Detached: the policy's objective must not train the critics.
        qvalues = self.q(clean, action, self.qvalue_network_params.detach())
        qvalue = qvalues.min(0).values
        weight = self.weight(batch, qvalues.detach().mean(0))
        if self.correction_action == "perturbed":
            action = self.act(perturbed, self.actor_network_params)
        predicted = self.predict(perturbed, action)
        error = weight * (predicted - self.data_next_state(batch)).square().mean(-1)
        sought = self.reduce(-qvalue / magnitude(self, batch, qvalue), batch)
        correction = self.reduce(error, batch, batch.has_next)
        share = self.correction_weight
        return (1 - share) * sought + share * correction, error

    @torch.no_grad()
    def weight(self, batch: Transitions, value: Tensor) -> Tensor:
        """Return the weight of each row's correction, ``[R]``, from its value."""
        # Of single steps, as the correction.
        after = next_states(batch.one_step, self.observation_keys, batch.done)
        action = self.act(after, self.actor_network_params)
        return value_gain_weight(
            value,
            self.q(after, action).mean(0),
            temperature=self.gain_temperature,
            largest=self.largest_weight,
        )

    def predict(self, states: TensorDictBase, action: Tensor) -> Tensor:
        """Return where the elites' mean says that an action leads, ``[R, S]``."""
        model = self.dynamics_network
        with self.dynamics_network_params.to_module(model, preserve_module_state=False):
            state = entry(states, model.in_keys[0])
            mean, _ = model.predict(state, action)
            return state + mean[model.elites].mean(0)[..., :-1]

    def data_next_state(self, batch: Transitions) -> Tensor:
        """Return the data's next state, ``[R, S]``; 0 after an end."""
        check_single_steps(batch, "the model of the dynamics")
        key = nested("next", self.dynamics_network.in_keys[0])
        found = entry(batch.one_step, key)
        # What follows an end may be anything, and 0 * nan is nan in the backward pass.
        return torch.where(batch.done.unsqueeze(-1), torch.zeros_like(found), found)
