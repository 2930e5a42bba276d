r"""Attacks on observations, within a box around the true ones.

The evaluation of "RORL: Robust Offline Reinforcement Learning via Conservative
Smoothing" (Yang et al., NeurIPS 2022), https://arxiv.org/abs/2206.02829. An adversary
needs the networks, so it acts between environment and policy, not in a wrapper.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule

from torchrl_osr._checks import check_choice
from torchrl_osr.lab.losses import Adversary
from torchrl_osr.lab.losses.adversary import TanhNormalPolicy, Values


def critics_of(loss: LossModule) -> Values:
    """Return the values of a loss's ``N`` critics as a function of states and actions.

    ``M`` perturbations and ``E`` episodes give ``[N, M, E]``.
    """

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
    method: Literal["sample", "gradient"] = "sample",
    num_samples: int = 50,
    seed: int = 0,
) -> Callable[[Tensor], Tensor]:
    r"""Return a deterministic policy ``[E, S]`` -> ``[E, A]`` under attack.

    Each number of an observation is off by at most :math:`\epsilon` standard
    deviations: uniformly (``"random"``), or as
    :class:`~torchrl_osr.lab.losses.Adversary` finds it, with the largest change of the
    policy (``"action_diff"``) or the action of lowest value (``"min_Q"``).

    Args:
        policy_distribution: the actor's ``get_dist``, for instance.
        qvalue: the critics, see :func:`critics_of`; only ``"min_Q"`` calls them.
        observation_norm: standardisation of the training data. Default: none.

    Keyword Args:
        epsilon: half-width of the box; RORL's go from 0, the bare policy, to 0.3.
        method: ``"sample"`` (default), or ``"gradient"``: RORL's first order with one
            start, its mixed order with 20.
        num_samples: draws, or starts of the gradient steps. Default 50.

    Examples:
        >>> from torchrl_osr.modules import tanh_gaussian_actor
        >>> actor = tanh_gaussian_actor(11, 3)
        >>> policy = attacked_policy(actor.get_dist, None, kind="random", epsilon=0.1)
        >>> policy(torch.zeros(4, 11)).shape
        torch.Size([4, 3])
    """
    check_choice("kind", kind, ("random", "action_diff", "min_Q"))
    # It checks the other arguments, also for "random".
    objective: Literal["min_Q", "action_diff"] = (
        "min_Q" if kind == "min_Q" else "action_diff"
    )
    adversary = Adversary(objective, method, epsilon, num_samples)
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
