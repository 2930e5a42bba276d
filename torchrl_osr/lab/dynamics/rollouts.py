"""Rollouts of a policy in a dynamics model, and the rules that end them.

Shapes: ``B`` starts, ``S`` observation, ``A`` action, ``n`` transitions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import Tensor, nn

from torchrl_osr.lab.dynamics.models import DynamicsEnsemble

Termination = Callable[[Tensor], Tensor]
"""Maps next observations ``[B, S]`` to bool ``[B]``."""


def never(observation: Tensor) -> Tensor:
    """Return ``False``."""
    return torch.zeros_like(observation[..., 0], dtype=torch.bool)


def hopper(observation: Tensor) -> Tensor:
    """Return where Gymnasium's Hopper is not healthy."""
    height, angle = observation[..., 0], observation[..., 1]
    state = observation[..., 1:].abs().amax(-1)
    return ~((height > 0.7) & (angle.abs() < 0.2) & (state < 100))


def walker2d(observation: Tensor) -> Tensor:
    """Return where Gymnasium's Walker2d is not healthy."""
    height, angle = observation[..., 0], observation[..., 1]
    return ~((height > 0.8) & (height < 2) & (angle.abs() < 1))


# The versions 2 to 5 of Gymnasium's tasks agree.
RULES = {"HalfCheetah": never, "Hopper": hopper, "Walker2d": walker2d}


def termination(env_id: str | None) -> Termination:
    """Return the rule by which a Gymnasium task ends, time limits apart."""
    found = re.fullmatch(r"(\w+)-v[2-5]", env_id or "")
    if found is None or found[1] not in RULES:
        raise ValueError(
            f"The package has no end rule of {env_id or 'a log'}, only of "
            f"{', '.join(RULES)}. If only a time limit ends it, set "
            "dynamics.terminations=never."
        )
    return RULES[found[1]]


def action_of(actor: nn.Module, state: Tensor, kind: InteractionType) -> Tensor:
    """Return the actions of an actor at states ``[B, S]``, ``[B, A]``."""
    with set_interaction_type(kind):
        batch = actor(TensorDict({"observation": state}, state.shape[:-1]))
    action: Tensor = batch["action"]
    return action


@torch.no_grad()
def rollout(
    model: DynamicsEnsemble,
    policy: Callable[[Tensor], Tensor],
    starts: Tensor,
    *,
    steps: int,
    terminated: Termination = never,
    max_disagreement: float = math.inf,
    halt_reward: float = 0.0,
    units: Tensor | float = 1.0,
) -> TensorDict:
    r"""Sample transitions of a policy in a model, with torch's global generator.

    They are rows ``[n]`` of a data set, with ``"uncertainty"`` ``[n, 1]``.

    Args:
        policy: maps states ``[B, S]`` to actions ``[B, A]``.
        starts: ``[B, S]``, in the units of the model's data, as all states.

    Keyword Args:
        steps: largest length of a rollout.
        terminated: of next states.
        max_disagreement: of the elites; rows above it end the task in their own state,
            as in MOReL (https://arxiv.org/abs/2005.05951).
        halt_reward: of such rows.
        units: factors ``[S + 1]`` of predictions in ``"uncertainty"``,
            :math:`\max_i \lVert \sigma_i \rVert_2` of all networks, MOPO's penalty.
    """
    state, kept = starts, []
    for _ in range(steps):
        seen = model.observed(state)
        action = policy(seen)
        mean, scale = model.predict(state, action)
        sample = model.sample(mean, scale)
        following, reward = state + sample[:, :-1], sample[:, -1:]
        unknown = (model.disagreement(mean) > max_disagreement).unsqueeze(-1)
        ended = terminated(following).unsqueeze(-1) | unknown
        following = torch.where(unknown, state, following)
        reward = torch.where(unknown, halt_reward, reward)
        finite = sample.isfinite().all(-1)
        after = {"observation": model.observed(following), "reward": reward}
        after |= {"done": ended, "terminated": ended}
        after["truncated"] = torch.zeros_like(ended)
        entries = {
            "observation": seen,
            "action": action,
            "next": after,
            "uncertainty": (scale * units).norm(dim=-1).amax(0).unsqueeze(-1),
        }
        kept.append(TensorDict(entries, [len(state)])[finite])
        state = following[finite & ~ended.squeeze(-1)]
        if not len(state):
            break
    return torch.cat(kept)


def perturbed_starts(
    model: DynamicsEnsemble, starts: Tensor, *, steps: int, **options: Any
) -> Tensor:
    """Sample as many states 1 to ``steps`` uniform actions later, before an end."""

    def policy(state: Tensor) -> Tensor:
        return 2 * torch.rand(len(state), model.action_dim, device=state.device) - 1

    rows = rollout(model, policy, starts, steps=steps, **options)
    following = rows["next", "observation"][~rows["next", "done"].squeeze(-1)]
    if not len(following):
        raise ValueError(
            "The model ends the task after every random action: train it longer "
            "(dynamics.steps)."
        )
    chosen: Tensor = following[torch.randint(len(following), [len(starts)])]
    return chosen
