r"""TD3+BC: a deterministic policy that seeks values and stays with the data's actions.

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
from torchrl.modules import TanhDelta

from torchrl_osr import functional
from torchrl_osr._checks import check_literals, check_positive, check_weight
from torchrl_osr.objectives.base import BaseLoss, Terms, TransitionKeys
from torchrl_osr.objectives.distributions import bounds_of, check_action, head_of
from torchrl_osr.objectives.step import Step, actor_critic_in_keys


class TD3BCLoss(BaseLoss):
    r"""TD3 with behaviour cloning (TD3+BC).

    .. math::
        L_\pi &= \mathbb E_D \Big[ \|\pi(s) - a\|^2 / A
            - \frac{\alpha}{\mathbb E_D |Q_1(s, \pi(s))|}\, Q_1(s, \pi(s)) \Big] \\
        L_Q &= \sum_i \mathbb E_D (Q_i - T)^2, \quad
        T = r + \gamma\,(1 - \text{terminated}) \min_i
            \bar Q_i(s', \bar\pi(s') + \epsilon)

    Presented in "A Minimalist Approach to Offline Reinforcement Learning",
    https://arxiv.org/abs/2106.06860. In TorchRL 0.14.1's ``TD3BCLoss`` the cloning term
    is a mean over the batch that is added to each row: masks and priority weights do
    not reach it, and with ``reduction="none"`` it is not the row's. The authors update
    policy and targets every second step; how often is the training loop's to say.

    Args:
        actor_network: writes the action; see
            :func:`~torchrl_osr.modules.deterministic_actor`.
        qvalue_network: one critic, copied by TorchRL, or a list of critics that keep
            their own weights (:func:`~torchrl_osr.modules.critic_ensemble`).

    Keyword Args:
        alpha: weight of the values against cloning. Default 2.5.
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

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_osr.modules import critic_ensemble, deterministic_actor
        >>> from torchrl_osr.lab.losses import TD3BCLoss
        >>> loss = TD3BCLoss(deterministic_actor(11, 3), critic_ensemble(11, 3))
        >>> updater = SoftUpdate(loss, tau=5e-3)
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(4, 11), "action": torch.rand(4, 3),
        ...     "next": {"observation": torch.randn(4, 11), "reward": torch.ones(4, 1),
        ...              "done": no, "terminated": no}}, [4])
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
        alpha: float = 2.5,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        low: float = -1.0,
        high: float = 1.0,
        **options: Any,
    ) -> None:
        check_literals(TD3BCLoss.__init__, locals())
        check_weight("alpha", alpha)
        check_smoothing(policy_noise, noise_clip, low, high, actor_network)
        super().__init__(**options)
        self._hold_actor_critic(
            actor_network,
            qvalue_network,
            delay_actor=self.delay_qvalue,
        )
        self.alpha = alpha
        self.policy_noise, self.noise_clip = policy_noise, noise_clip
        self.low, self.high = low, high
        self.make_value_estimator()

    def _input_keys(self) -> list[NestedKey]:
        return actor_critic_in_keys(self, perturbed=False)

    def _output_keys(self) -> tuple[list[NestedKey], list[NestedKey]]:
        metrics = ["cloning_error", "pred_value", "target_value"]
        return ["loss_actor", "loss_qvalue"], metrics

    def _terms(self, tensordict: TensorDictBase) -> Terms:
        step = Step(self, tensordict, perturbed=False)
        actor, cloning_error = self.actor_loss(step)
        params = self.qvalue_network_params
        pred_value = step.qvalue(step.states[0], step.data_action, params)
        target_value = self._target_value(step)
        qvalue = step.reduce(step.td_distance(pred_value, target_value))
        step.write_priority(pred_value, target_value)
        metrics = {
            "cloning_error": self._mean(cloning_error, tensordict, step.of_data),
            "pred_value": step.mean(pred_value),
            "target_value": step.mean(target_value),
        }
        losses = {"loss_actor": actor, "loss_qvalue": qvalue}
        return losses, metrics

    def actor_loss(self, step: Step) -> tuple[Tensor, Tensor]:
        r""":math:`L_\pi`, and the squared distance to the data's action, ``[B]``."""
        action = step.action(step.states[0], self.actor_network_params)
        check_action(step.data_action, action.shape[-1], self.tensor_keys.action)
        # Detached: the policy's objective shall not train the critics.
        params = self.qvalue_network_params.detach()
        qvalue = step.qvalue(step.states[0], action, params)[0]
        cloning_error = functional.cloning_error(action, step.data_action)
        cloning_error = step.cloned(cloning_error)
        magnitude = step.magnitude(qvalue)
        objective = functional.td3_bc_objective(
            qvalue, cloning_error, magnitude, self.alpha
        )
        return step.reduce(objective), cloning_error

    @torch.no_grad()
    def _target_value(self, step: Step) -> Tensor:
        """The TD target, ``[B]``, with target policy smoothing."""
        _, next_value = smoothed_action_and_value(self, step)
        return step.td_target(next_value)


def check_smoothing(
    policy_noise: float,
    noise_clip: float,
    low: float,
    high: float,
    actor_network: TensorDictModuleBase,
) -> None:
    """Raise a ValueError unless target policy smoothing can have these options."""
    check_weight("policy_noise", policy_noise)
    check_positive("noise_clip", noise_clip, minimum=0)
    if not low < high:
        raise ValueError(f"high must be above low={low}, got {high}.")
    distribution, options = head_of(actor_network)
    if distribution is not TanhDelta:
        return
    sides = zip(("low", "high"), (low, high), bounds_of(options), strict=True)
    for name, ours, theirs in sides:
        if not bool((theirs == ours).all()):
            raise ValueError(
                f"the loss has {name}={ours}, but its actor {name}={theirs.tolist()}: "
                "give both the same."
            )


def smoothed_action_and_value(loss: Any, step: Step) -> tuple[Tensor, Tensor]:
    r"""TD3's target policy smoothing, and what the target critics say of it.

    Args:
        loss: holds the target networks, ``policy_noise``, ``noise_clip``, ``low`` and
            ``high``.
        step: of its batch.

    Returns:
        :math:`\bar\pi(s') + \epsilon`, ``[B, A]``, and the smallest of its values,
        ``[B]``.
    """
    state = step.states[1]
    action = step.action(state, loss.target_actor_network_params)
    noise = loss.policy_noise * torch.randn_like(action)
    noise = noise.clamp(-loss.noise_clip, loss.noise_clip)
    action = (action + noise).clamp(loss.low, loss.high)
    qvalue = step.qvalue(state, action, loss.target_qvalue_network_params)
    return action, functional.bootstrap_value(qvalue)
