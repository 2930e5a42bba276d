"""Attacks on observations, as in RORL's evaluation, https://arxiv.org/abs/2206.02829.

An adversary needs the networks, so it acts between environment and policy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule

from torchrl_osr.lab.losses import Adversary
from torchrl_osr.lab.losses.adversary import TanhNormalPolicy, Values


def critics_of(loss: LossModule) -> Values:
    """Return the values ``[N, ...]`` of a loss's critics, of states and actions."""

    def values(states: TensorDictBase, action: Tensor) -> Tensor:
        keys, each = loss.tensor_keys, []
        for params in loss.qvalue_network_params.detach().unbind(0):
            batch = states.copy().set(keys.action, action)
            with params.to_module(loss.qvalue_network, preserve_module_state=False):
                batch = loss.qvalue_network(batch)
            each.append(batch.get(keys.state_action_value).squeeze(-1))
        return torch.stack(each)

    return values


def attacked_policy(
    policy_distribution: TanhNormalPolicy,
    qvalue: Values,
    observation_norm: ObservationNorm | None = None,
    *,
    kind: Literal["random", "action_diff", "min_Q"],
    epsilon: float,
    num_samples: int = 50,
    seed: int = 0,
) -> Callable[[Tensor], Tensor]:
    """Return a deterministic policy ``[E, S]`` -> ``[E, A]`` under attack.

    Each number of an observation is off by at most ``epsilon`` standard deviations.
    ``"random"`` draws uniformly. Otherwise
    :class:`~torchrl_osr.lab.losses.Adversary` seeks the largest change of the policy
    (``"action_diff"``) or the action of lowest value (``"min_Q"``).

    Args:
        policy_distribution: the actor's ``get_dist``, for instance.
        qvalue: the critics, see :func:`critics_of`; only ``"min_Q"`` calls them.
        observation_norm: standardisation of the training data. Default: none.

    Examples:
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> actor = tanh_gaussian_actor(11, 3)
        >>> policy = attacked_policy(actor.get_dist, None, kind="random", epsilon=0.1)
        >>> policy(torch.zeros(4, 11)).shape
        torch.Size([4, 3])
    """
    # It checks the arguments, also for "random".
    objective: Any = "action_diff" if kind == "random" else kind
    adversary = Adversary(objective, epsilon=epsilon, num_samples=num_samples)
    generator = torch.Generator().manual_seed(seed)

    @torch.no_grad()
    def policy(observation: Tensor) -> Tensor:
        if observation_norm is not None:
            observation = (observation - observation_norm.loc) / observation_norm.scale
        states = TensorDict({"observation": observation}, [len(observation)])
        if kind == "random":
            uniform = torch.rand(observation.shape, generator=generator)
            states["observation"] = observation + epsilon * (2 * uniform - 1)
        else:
            states = adversary.perturb(
                states, ["observation"], policy_distribution, qvalue, generator
            )
        action: Tensor = policy_distribution(states).deterministic_sample
        return action

    return policy
