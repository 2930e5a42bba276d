r"""ReBRAC: TD3+BC with a second penalty, in the critics' target.

Shapes: ``B`` batch (any leading dimensions), ``A`` action, ``N`` critics. The equations
are in :mod:`torchrl_osr.functional`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_weight
from torchrl_osr._entries import column, entry
from torchrl_osr.lab.losses.td3_bc import check_smoothing, smoothed_action_and_value
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.distributions import check_action
from torchrl_osr.objectives.step import Step, actor_critic_in_keys


class ReBRACLoss(BaseLoss):
    r"""Revisited behaviour-regularised actor-critic (ReBRAC).

    .. math::
        L_\pi &= \mathbb E_D \Big[ \beta_1 \|\pi(s) - a\|^2
            - \frac{\min_i Q_i(s, \pi(s))}{\mathbb E_D |\min_i Q_i(s, \pi(s))|} \Big]
            \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2, \quad
        T = r + \gamma\,(1 - \text{terminated}) \Big[ \min_i \bar Q_i(s', \tilde a')
            - \beta_2 \|\tilde a' - a'\|^2 \Big], \quad
        \tilde a' = \bar\pi(s') + \epsilon

    Presented in "Revisiting the Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2305.09836. The critics shall have layer normalisation
    (:func:`~torchrl_osr.modules.critic_ensemble`). The authors update policy and
    targets every second step, which is the training loop's to do.

    :math:`a'` is what the data did at :math:`s'`, the entry ``("next", "action")``.
    Where an episode was cut (``done`` and not ``terminated``) nobody knows it: there
    the penalty does not count, and whatever stands in the entry is not read.

    Args:
        actor_network: writes the action; see
            :func:`~torchrl_osr.modules.deterministic_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).

    Keyword Args:
        actor_bc_coef: :math:`\beta_1`, weight of the policy's distance from the data's
            action. Default 0.01.
        critic_bc_coef: :math:`\beta_2`, weight of the same in the target. Default 0.01;
            with 0 *here* no next action is read.
        policy_noise: standard deviation of :math:`\epsilon`, in units of the action.
            Default 0.2.
        noise_clip: largest magnitude of :math:`\epsilon`. Default 0.5.
        low, high: action bounds, between which the target's action is kept; those of
            the actor's :class:`~torchrl.modules.TanhDelta`, if it ends in one. Default
            -1 and 1.
        options: of every loss, see :class:`~torchrl_osr.objectives.BaseLoss`.

    Raises:
        ValueError: if an option is out of its range; in the call, if the batch is
            empty.
        KeyError: in the call, if the batch has no next action.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
        >>> from torchrl_osr.lab.losses import ReBRACLoss
        >>> critics = critic_ensemble(11, 3, layer_norm=True)
        >>> loss = ReBRACLoss(deterministic_actor(11, 3), critics)
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no, "action": torch.rand(4, 3)}
        ... }, [4])
        >>> sorted(loss(batch).keys())
        ['cloning_error', 'loss_actor', 'loss_qvalue', 'pred_value', 'target_value']
    """

    _AcceptedKeys = TransitionKeys
    default_keys = TransitionKeys
    tensor_keys: TransitionKeys

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        actor_bc_coef: float = 0.01,
        critic_bc_coef: float = 0.01,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        low: float = -1.0,
        high: float = 1.0,
        **options: Any,
    ) -> None:
        check_literals(ReBRACLoss.__init__, locals())
        check_weight("actor_bc_coef", actor_bc_coef)
        check_weight("critic_bc_coef", critic_bc_coef)
        check_smoothing(policy_noise, noise_clip, low, high, actor_network)
        super().__init__(**options)
        self._hold_actor_critic(
            actor_network,
            qvalue_network,
            delay_actor=self.delay_qvalue,
        )
        self.actor_bc_coef, self.critic_bc_coef = actor_bc_coef, critic_bc_coef
        self.has_penalty = critic_bc_coef > 0
        self.policy_noise, self.noise_clip = policy_noise, noise_clip
        self.low, self.high = low, high
        self.make_value_estimator()

    def _input_keys(self) -> list[NestedKey]:
        keys = actor_critic_in_keys(self, perturbed=False)
        return keys + (self._next_keys("action") if self.has_penalty else [])

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        metrics = ["cloning_error", "pred_value", "target_value"]
        return ["loss_actor", "loss_qvalue"], metrics

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=False)
        actor, cloning_error = self.actor_loss(step)
        params = self.qvalue_network_params
        pred_value = step.qvalue(step.states[0], step.data_action, params)
        target_value = self._target_value(step)
        distance = step.td_distance(pred_value, target_value)
        step.write_priority(pred_value, target_value)
        metrics = {
            "cloning_error": self._mean(cloning_error, tensordict, step.of_data),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
        }
        losses = {"loss_actor": actor, "loss_qvalue": step.reduce(distance)}
        return losses, metrics

    def actor_loss(self, step: Step) -> tuple[Tensor, Tensor]:
        r""":math:`L_\pi`, and the squared distance to the data's action, ``[B]``."""
        action = step.action(step.states[0], self.actor_network_params)
        check_action(step.data_action, action.shape[-1], self.tensor_keys.action)
        # Detached: the policy's objective shall not train the critics.
        params = self.qvalue_network_params.detach()
        qvalue = step.qvalue(step.states[0], action, params).min(0).values
        distance = step.cloned(functional.action_distance(action, step.data_action))
        magnitude = step.magnitude(qvalue)
        objective = functional.rebrac_objective(
            qvalue, distance, magnitude, self.actor_bc_coef
        )
        return step.reduce(objective), distance

    @torch.no_grad()
    def _target_value(self, step: Step) -> Tensor:
        """The TD target, ``[B]``: smoothed, and less the penalty."""
        action, next_value = smoothed_action_and_value(self, step)
        if self.has_penalty:
            key, done = self._next_keys("action", "done")
            data_action = entry(step.tensordict, key)
            check_action(data_action, action.shape[-1], key)
            penalty = functional.action_distance(action, data_action)
            ended = column(step.tensordict, done).bool()
            penalty = penalty.masked_fill(ended, 0.0)
            next_value = next_value - self.critic_bc_coef * penalty
        return step.td_target(next_value)
