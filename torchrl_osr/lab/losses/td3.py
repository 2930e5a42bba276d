r"""What TD3+BC, ReBRAC and SCAS share: target policy smoothing and the actor's scale.

Shapes: ``R`` rows, ``A`` action, ``N`` critics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.modules import TanhDelta

from torchrl_osr import functional as F
from torchrl_osr._checks import check_weight
from torchrl_osr.objectives.actor_critic import ActorCriticLoss
from torchrl_osr.objectives.networks import bounds_of, head_of
from torchrl_osr.objectives.transitions import Transitions


class TargetPolicySmoothing:
    r"""TD3's target: :math:`\min_i \bar Q_i(s', \bar\pi(s') + \epsilon)`.

    "Addressing Function Approximation Error in Actor-Critic Methods",
    https://arxiv.org/abs/1802.09477. :math:`\epsilon` is clipped Gaussian noise; the
    action stays within its bounds.

    Args:
        policy_noise: standard deviation of :math:`\epsilon`, in units of the action.
        noise_clip: largest magnitude of :math:`\epsilon`.
    """

    def __init__(self, policy_noise: float, noise_clip: float) -> None:
        check_weight("policy_noise", policy_noise)
        check_weight("noise_clip", noise_clip)
        self.policy_noise, self.noise_clip = policy_noise, noise_clip

    def __call__(
        self, loss: ActorCriticLoss, batch: Transitions
    ) -> tuple[Tensor, Tensor]:
        """Return the smoothed action, ``[R, A]``, and its smallest value, ``[R]``."""
        action = loss.act(batch.s_next, loss.target_actor_network_params)
        noise = self.policy_noise * torch.randn_like(action)
        noise = noise.clamp(-self.noise_clip, self.noise_clip)
        action = (action + noise).clamp(loss.action_low, loss.action_high)
        qvalue = loss.q(batch.s_next, action, loss.target_qvalue_network_params)
        return action, F.bootstrap_value(qvalue)


def register_td3(
    loss: ActorCriticLoss,
    actor_network: TensorDictModuleBase,
    qvalue_network: TensorDictModule | Sequence[TensorDictModule],
    low: Any,
    high: Any,
) -> None:
    """Register a deterministic actor with its bounds, critics and their targets.

    Args:
        loss: the loss that holds them.
        actor_network: writes the action.
        qvalue_network: one critic or a list.
        low, high: bounds of the action, a number or ``[A]``. Default: those of the
            actor's :class:`~torchrl.modules.TanhDelta`.

    Raises:
        ValueError: if the bounds are not known, or are not the actor's.
    """
    head, options = head_of(actor_network)
    own = bounds_of(options) if head is TanhDelta else (None, None)
    for name, given, actors in zip(("low", "high"), (low, high), own, strict=True):
        if given is None and actors is None:
            raise ValueError(
                f"{name} is needed: the actor is a module that does not tell its "
                "bounds. Pass low= and high= of the environment's actions."
            )
        bound = torch.as_tensor(actors if given is None else given).float()
        if actors is not None and not torch.equal(bound.expand_as(actors), actors):
            raise ValueError(
                f"the loss has {name}={bound.tolist()}, but its actor "
                f"{name}={actors.tolist()}: leave it out."
            )
        loss.register_buffer(f"action_{name}", bound, persistent=False)
    if not bool((loss.action_low < loss.action_high).all()):
        raise ValueError(f"high must be above low={low}, got {high}.")
    loss.register_actor_critic(
        actor_network, qvalue_network, delay_actor=loss.delay_qvalue
    )
    loss.make_value_estimator()


def magnitude(loss: ActorCriticLoss, batch: Transitions, value: Tensor) -> Tensor:
    """Return the mean magnitude of values ``[R]``, detached; 1 where it is 0."""
    mean = loss.mean(value.abs(), batch)
    return torch.where(mean == 0, torch.ones_like(mean), mean)


def cloning_error(action: Tensor, data_action: Tensor) -> Tensor:
    r"""Return :math:`\frac1A \sum_d (\pi_d(s) - a_d)^2`, ``[R]``."""
    return (action - data_action).square().mean(-1)
