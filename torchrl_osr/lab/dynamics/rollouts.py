"""Roll-outs of a policy in a dynamics model, and the rules that end them.

Shapes: ``B`` starts, ``S`` observation, ``A`` action, ``E`` networks, ``D = S + 1``
predicted entries, ``n`` transitions, at most ``B`` times the steps.
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

from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble, EliteNetworks

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
"""By the name of the task, for the versions 2 to 5 of Gymnasium, which agree."""


def termination(env_id: str) -> Termination:
    """Return the rule by which a Gymnasium task ends, time limits apart.

    Raises:
        ValueError: the package has no rule for this task.

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
    """Transitions from a model.

    Attributes:
        rows: ``[n]`` with the entries of a data set, and ``"step"``,
            ``"disagreement"`` and ``"uncertainty"``, ``[n, 1]``.
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
    units: Tensor | None = None,
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
        max_disagreement: rows with more
            :meth:`~torchrl_osr.lab.dynamics.DynamicsEnsemble.disagreement` are
            rejected, as are rows that are not finite. Default: infinity.
        halt_reward: keep rows with more disagreement, as ends of the task with this
            reward in their own state: the HALT of MOReL
            (https://arxiv.org/abs/2005.05951). Default: reject them.
        units: factors ``[D]`` of the predictions in ``"uncertainty"``,
            :math:`\max_i \lVert \sigma_i \rVert_2` over all networks, MOPO's penalty.
            Default: 1.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble, rollout, termination
        >>> model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=2)
        >>> starts = torch.zeros(4, 11)
        >>> starts[:, 0] = 1.25
        >>> rows, num_rejected = rollout(
        ...     model, lambda state: torch.rand(len(state), 3), starts, steps=5,
        ...     terminated=termination("Hopper-v5"))
        >>> rows["next", "observation"].shape[-1], num_rejected
        (11, 0)
    """
    state, rejected, kept = starts, 0, []
    for step in range(steps):
        action = policy(state)
        mean, scale = prediction = model.predict(state, action)
        apart = model.disagreement(mean)
        deviation = vector_norm(scale if units is None else scale * units, dim=-1)
        sample = model.sample(prediction)
        following, reward = state + sample[:, :-1], sample[:, -1:]
        finite = sample.isfinite().all(-1)
        known = finite & (apart <= max_disagreement)
        ended = terminated(following).unsqueeze(-1)
        if halt_reward is not None:
            unknown = ~known.unsqueeze(-1)
            following = torch.where(unknown, state, following)
            reward = torch.where(unknown, halt_reward, reward)
            ended, known = ended | unknown, finite
        row = TensorDict(
            {
                "observation": state,
                "action": action,
                "next": {
                    "observation": following,
                    "reward": reward,
                    "done": ended,
                    "terminated": ended,
                    "truncated": torch.zeros_like(ended),
                },
                "step": torch.full_like(ended, step, dtype=torch.long),
                "disagreement": apart.unsqueeze(-1),
                "uncertainty": deviation.amax(0).unsqueeze(-1),
            },
            [len(state)],
        )
        rejected += int((~known).sum())
        kept.append(row[known])
        state = following[known & ~ended.squeeze(-1)]
        if not len(state):
            break
    return Rollout(torch.cat(kept), rejected)


class MeanRollout(NamedTuple):
    """Mean predictions of each network for ``T`` steps.

    Attributes:
        reward: of each step, 0 after the end, ``[T, E B]``, the first network's first.
        alive: whether the task goes on after each step, bool ``[T, E B]``.
        state: the last one, or the one before the end, ``[E B, S]``.
    """

    reward: Tensor
    alive: Tensor
    state: Tensor


@torch.no_grad()
def mean_rollout(
    networks: EliteNetworks,
    policy: Callable[[Tensor], Tensor],
    starts: Tensor,
    *,
    steps: int,
    terminated: Termination = never,
) -> MeanRollout:
    """Roll each network out by itself, with its mean predictions.

    A prediction that is not finite ends the task without a reward.

    Args:
        networks: of the dynamics, ``E``.
        policy: maps states ``[E B, S]``, the first network's first, to actions.
        starts: ``[B, S]``.

    Keyword Args:
        steps: ``T``.
        terminated: of next states. Default: never.
    """
    number = networks.num_networks
    state = starts.repeat(number, 1)
    going = torch.ones_like(state[:, 0], dtype=torch.bool)
    reward = torch.zeros(steps, len(going), device=starts.device)
    alive = torch.zeros_like(reward, dtype=torch.bool)
    for step in range(steps):
        rows = number, len(starts), -1
        action = policy(state).reshape(rows)
        change = networks(state.view(rows), action).flatten(0, 1)
        going = going & change.isfinite().all(-1)
        reward[step] = change[:, -1].where(going, 0.0)
        following = state + change[:, :-1]
        going = going & ~terminated(following)
        alive[step] = going
        # States after the end must not grow until they overflow.
        state = torch.where(going.unsqueeze(-1), following, state)
        if not going.any():
            break
    return MeanRollout(reward, alive, state)


def uniform_policy(action_dim: int) -> Callable[[Tensor], Tensor]:
    """Return a policy whose actions are uniform in [-1, 1]."""
    return lambda state: 2 * torch.rand(len(state), action_dim, device=state.device) - 1


def perturbed_starts(
    model: DynamicsEnsemble, starts: Tensor, *, steps: int, **options: Any
) -> Tensor:
    """Sample states that random actions lead to in a model, ``[B, S]``.

    Args:
        model: of the dynamics.
        starts: ``[B, S]``.

    Keyword Args:
        steps: states after 1 to ``steps`` uniform actions count, if the task goes on.
        options: ``terminated``, ``max_disagreement`` and ``halt_reward`` of
            :func:`rollout`.
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
    *,
    terminated: Termination = never,
    **options: Any,
) -> Rollout:
    """Sample transitions that lead into given states, as in ROMI.

    "Offline Reinforcement Learning with Reverse Model-based Imagination",
    https://arxiv.org/abs/2110.00188. Rows that begin where the task has ended are
    rejected.

    Args:
        model: trained on :func:`reverse_transitions`.
        policy: maps next states ``[B, S]`` to actions that led there, ``[B, A]``.
        ends: next states of the first rows, ``[B, S]``.

    Keyword Args:
        terminated: of states. Default: never.
        options: others of :func:`rollout`.

    Returns:
        Rows in the direction of time, none of them terminated.
    """
    rows, rejected = rollout(model, policy, ends, terminated=terminated, **options)
    acted = ~rows["next", "terminated"].squeeze(-1)
    return Rollout(reverse_transitions(rows[acted]), rejected + int((~acted).sum()))


def reverse_transitions(rows: TensorDict) -> TensorDict:
    """Return the same transitions with state and next state exchanged."""
    reverse = rows.copy()
    reverse["observation"] = rows["next", "observation"]
    reverse["next", "observation"] = rows["observation"]
    return reverse
