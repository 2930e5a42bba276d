"""Rollouts of a policy in a dynamics model, and the rules that end them.

Shapes: ``B`` starts, ``S`` observation, ``A`` action, ``n`` transitions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
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


def maze(observation: Tensor) -> Tensor:
    """Return where a point or an ant is at the goal of Gymnasium-Robotics' mazes."""
    position, goal = observation[..., :2], observation[..., 2:4]
    return ~((position - goal).norm(dim=-1) > 0.45)


# The versions 2 to 5 of Gymnasium's tasks agree.
RULES = {"HalfCheetah": never, "Hopper": hopper, "Walker2d": walker2d}


def known_rule(env_id: str | None) -> Termination | None:
    """Return the rule by which a Gymnasium task ends, time limits apart."""
    found = re.fullmatch(r"((?:Ant|Point)Maze)?(\w+)-v[2-5]", env_id or "")
    return found and (maze if found[1] else RULES.get(found[2]))


def termination(
    env_id: str | None,
    limits: Tensor,
    loc: Tensor | float = 0.0,
    scale: Tensor | float = 1.0,
) -> Termination:
    """Return the rule that ends a task, for states ``(s - loc) / scale``.

    A task without a known rule ends beyond ``limits`` ``[2, S]`` of these states.
    """
    rule = known_rule(env_id)
    if rule is not None:
        return lambda state: rule(state * scale + loc)
    low, high = limits
    return lambda state: ((state < low) | (state > high)).any(-1)


def task_limits(
    data: TensorDictBase, loc: Tensor | float = 0.0, scale: Tensor | float = 1.0
) -> Tensor:
    """Return limits ``[2, S]`` beyond which transitions ``[N]`` show that a task ends.

    They bound the states from which the task went on. The limit that explains most
    ends comes first; one that explains less than 2 % of them stays infinite. Print them
    in the units of ``s``: rows hold ``(s - loc) / scale``. Raise a ValueError if they
    miss more than one end of ten.
    """
    ended = data["next", "terminated"].squeeze(-1)
    states = data["next", "observation"]
    if ended.all():
        raise ValueError("every row is terminated: give whole episodes, not just ends.")
    low, high = states[~ended].aminmax(dim=0)
    found = torch.stack([low, high]).flatten()
    limits = torch.stack([low - math.inf, high + math.inf]).flatten()
    beyond = torch.cat([states[ended] < low, states[ended] > high], 1)
    number, missed = max(1, len(beyond)), beyond
    while missed.any() and (share := missed.sum(0) / number).max() >= 0.02:
        best = share.argmax()
        limits[best] = found[best]
        missed = missed[~missed[:, best]]
    if len(missed) > 0.1 * number:
        raise ValueError(
            f"{1 - len(missed) / number:.0%} of the log's ends are where an observed "
            "number leaves its range; expected 90 %. Rollouts of a model do not know "
            "where this task ends: do without them, or give next_observation if the "
            "log lacks the states in which episodes ended."
        )
    limits = limits.view(2, -1)
    ends = [
        f"observation[{entry}] {sign} {value:.4g}"
        for sign, values in zip("<>", (limits * scale + loc).tolist(), strict=True)
        for entry, value in enumerate(values)
        if math.isfinite(value)
    ]
    where = f"where {' or '.join(ends)}" if ends else "never"
    print("in rollouts, the task ends", where)
    return limits


def action_of(actor: nn.Module, state: Tensor, kind: InteractionType) -> Tensor:
    """Return the actions of an actor at states ``[B, S]``, ``[B, A]``."""
    with set_interaction_type(kind):
        batch = actor(TensorDict({"observation": state}, state.shape[:-1]))
    return batch["action"]


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
        entries = {"observation": seen, "action": action, "next": after}
        entries["uncertainty"] = (scale * units).norm(dim=-1).amax(0).unsqueeze(-1)
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
    return following[torch.randint(len(following), [len(starts)])]
