"""Roll-outs of a policy in a dynamics model, and the rules that end them.

Shapes: ``B`` starts, ``S`` observation, ``A`` action, ``n`` transitions, at most ``B``
times the steps.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.linalg import vector_norm

from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble

Termination = Callable[[Tensor], Tensor]
"""Maps next observations ``[B, S]`` to bool ``[B]``."""


def never(observation: Tensor) -> Tensor:
    """Return ``False`` for each of ``[B, S]``."""
    return torch.zeros_like(observation[..., 0], dtype=torch.bool)


def hopper(observation: Tensor) -> Tensor:
    """Return where Gymnasium's ``is_healthy`` does not hold for Hopper."""
    height, angle = observation[..., 0], observation[..., 1]
    state = observation[..., 1:].abs().amax(-1)
    return ~((height > 0.7) & (angle.abs() < 0.2) & (state < 100))


def walker2d(observation: Tensor) -> Tensor:
    """Return where Gymnasium's ``is_healthy`` does not hold for Walker2d."""
    height, angle = observation[..., 0], observation[..., 1]
    return ~((height > 0.8) & (height < 2) & (angle.abs() < 1))


RULES = {"HalfCheetah": never, "Hopper": hopper, "Walker2d": walker2d}
"""For the versions 2 to 5 of Gymnasium, which agree."""


def termination(env_id: str) -> Termination:
    """Return the rule by which a Gymnasium task ends, time limits apart.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import termination
        >>> standing, fallen = torch.zeros(2, 11)
        >>> standing[0], fallen[0] = 1.2, 0.6
        >>> termination("Hopper-v5")(torch.stack([standing, fallen]))
        tensor([False,  True])
    """
    found = re.fullmatch(r"(\w+)-v[2-5]", env_id)
    if found is None or found[1] not in RULES:
        raise ValueError(
            f"No rule is known by which {env_id} ends, only those of "
            f"{', '.join(RULES)}. If a time limit alone ends it, set "
            "dynamics.terminations=never."
        )
    return RULES[found[1]]


class Rollout(NamedTuple):
    """Synthetic transitions.

    Attributes:
        rows: ``[n]`` with the entries of a data set, and ``"uncertainty"``, ``[n, 1]``.
        num_rejected: rows that were dropped and ended their roll-outs.
    """

    rows: TensorDict
    num_rejected: int


@torch.no_grad()
def rollout(
    model: DynamicsEnsemble,
    policy: Callable[[Tensor], Tensor],
    starts: Tensor,
    *,
    steps: int,
    terminated: Termination = never,
    max_disagreement: float = math.inf,
    halt_reward: float | None = None,
    units: Tensor | float = 1.0,
) -> Rollout:
    r"""Sample transitions of a policy in a model.

    Each step draws an elite for each row, and the next state and reward from its
    Gaussian, with torch's global generator.

    Args:
        model: of the dynamics.
        policy: maps states ``[B, S]`` to actions ``[B, A]``.
        starts: ``[B, S]``, in the units of the model's data.

    Keyword Args:
        steps: largest length of a roll-out.
        terminated: of next states, in the same units. Default: never.
        max_disagreement: of the elites; rows with more, or that are not finite, are
            rejected. Default: infinity.
        halt_reward: keep rows with more disagreement, as ends of the task with this
            reward in their own state: the HALT of MOReL
            (https://arxiv.org/abs/2005.05951). Default: reject them.
        units: factors ``[S + 1]`` of predictions in ``"uncertainty"``,
            :math:`\max_i \lVert \sigma_i \rVert_2` of all networks, MOPO's penalty.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble, rollout
        >>> model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=2)
        >>> rows, num_rejected = rollout(
        ...     model, lambda state: torch.rand(4, 3), torch.zeros(4, 11), steps=5)
        >>> rows["next", "observation"].shape, num_rejected
        (torch.Size([20, 11]), 0)
    """
    state, rejected, kept = starts, 0, []
    for _ in range(steps):
        action = policy(state)
        mean, scale = prediction = model.predict(state, action)
        sample = model.sample(prediction)
        following, reward = state + sample[:, :-1], sample[:, -1:]
        finite = sample.isfinite().all(-1)
        known = finite & (model.disagreement(mean) <= max_disagreement)
        ended = terminated(following).unsqueeze(-1)
        if halt_reward is not None:
            unknown = ~known.unsqueeze(-1)
            following = torch.where(unknown, state, following)
            reward = torch.where(unknown, halt_reward, reward)
            ended, known = ended | unknown, finite
        entries = {
            "observation": state,
            "action": action,
            "next": {
                "observation": following,
                "reward": reward,
                "done": ended,
                "terminated": ended,
                "truncated": torch.zeros_like(ended),
            },
            "uncertainty": vector_norm(scale * units, dim=-1).amax(0).unsqueeze(-1),
        }
        rejected += int((~known).sum())
        kept.append(TensorDict(entries, [len(state)])[known])
        state = following[known & ~ended.squeeze(-1)]
        if not len(state):
            break
    return Rollout(torch.cat(kept), rejected)


def uniform_policy(action_dim: int) -> Callable[[Tensor], Tensor]:
    """Return a policy whose actions are uniform in [-1, 1]."""
    return lambda state: 2 * torch.rand(len(state), action_dim, device=state.device) - 1


def perturbed_starts(
    model: DynamicsEnsemble, starts: Tensor, *, steps: int, **options: Any
) -> Tensor:
    """Sample states in which the task goes on after 1 to ``steps`` uniform actions.

    Args:
        model: of the dynamics.
        starts: ``[B, S]``; as many states are returned.

    Keyword Args:
        options: of :func:`rollout`.
    """
    policy = uniform_policy(model.action_dim)
    rows, _ = rollout(model, policy, starts, steps=steps, **options)
    following = rows["next", "observation"][~rows["next", "done"].squeeze(-1)]
    if not len(following):
        raise ValueError(
            "The model ends the task after every random action: train it longer "
            "(dynamics.steps)."
        )
    chosen: Tensor = following[torch.randint(len(following), [len(starts)])]
    return chosen


def reverse_rollout(
    model: DynamicsEnsemble,
    policy: Callable[[Tensor], Tensor],
    ends: Tensor,
    **options: Any,
) -> Rollout:
    """Sample transitions that lead into given states, as in ROMI.

    "Offline Reinforcement Learning with Reverse Model-based Imagination",
    https://arxiv.org/abs/2110.00188. Rows that begin after the task's end are rejected.

    Args:
        model: trained on :func:`reverse_transitions`.
        policy: maps next states ``[B, S]`` to actions that led there, ``[B, A]``.
        ends: next states of the first rows, ``[B, S]``.

    Keyword Args:
        options: of :func:`rollout`.
    """
    rows, rejected = rollout(model, policy, ends, **options)
    acted = ~rows["next", "terminated"].squeeze(-1)
    return Rollout(reverse_transitions(rows[acted]), rejected + int((~acted).sum()))


def reverse_transitions(rows: TensorDict) -> TensorDict:
    """Return the same transitions with state and next state exchanged."""
    reverse = rows.copy()
    reverse["observation"] = rows["next", "observation"]
    reverse["next", "observation"] = rows["observation"]
    return reverse
