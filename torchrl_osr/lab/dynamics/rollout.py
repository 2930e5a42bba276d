"""Roll-outs of a policy in a dynamics model.

Shapes: ``B`` starts, ``S`` observation, ``A`` action, ``E`` networks, ``D = S + 1``
predicted entries, ``n`` imagined rows, at most ``B`` times the steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_osr._checks import check_positive
from torchrl_osr.lab.dynamics.elite_networks import EliteNetworks
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.dynamics.equations import largest_deviation
from torchrl_osr.lab.dynamics.termination import Termination, never


class Imagined(NamedTuple):
    """What roll-outs have given.

    Attributes:
        rows: transitions ``[n]`` with the entries of a data set, and ``"step"`` of the
            roll-out, ``"disagreement"`` and ``"uncertainty"``, ``[n, 1]``.
        refused: number of rows that were not taken and ended their roll-outs.
    """

    rows: TensorDict
    refused: int


@torch.no_grad()
def imagine(
    model: DynamicsEnsemble,
    policy: Callable[[Tensor], Tensor],
    starts: Tensor,
    *,
    steps: int,
    terminated: Termination = never,
    max_disagreement: float = math.inf,
    halt_reward: float | None = None,
    units: Tensor | None = None,
) -> Imagined:
    r"""Transitions of a policy in a model, from given states on.

    At each step and for each row, one of the elites is drawn, and the next state and
    reward from its Gaussian, with torch's global generator. A roll-out ends where
    ``terminated`` says so; the row that leads there is kept.

    Args:
        model: of the dynamics.
        policy: maps states ``[B, S]`` to actions ``[B, A]``.
        starts: first states ``[B, S]``, in the units of the model's data.

    Keyword Args:
        steps: number of steps, at most.
        terminated: of next states in the units of the model's data, see
            :func:`~torchrl_osr.lab.dynamics.termination` for rules in the task's own.
            Default: never.
        max_disagreement: rows whose
            :meth:`~torchrl_osr.lab.dynamics.DynamicsEnsemble.disagreement` is above
            that are
            refused: nobody knows what follows. Rows that are not finite are refused,
            too. Default: infinity.
        halt_reward: keep these rows instead, each as an end of the task with this
            reward, like the HALT of MOReL (https://arxiv.org/abs/2005.05951, definition
            1); the next state is then the state itself. Default: they are refused.
        units: factors ``[D]`` that bring predictions to the units in which
            ``"uncertainty"`` is measured. Default: 1, those of the model's data.

    Returns:
        The rows; ``"uncertainty"`` is
        :func:`~torchrl_osr.lab.dynamics.equations.largest_deviation` of all networks,
        MOPO's
        penalty.

    Raises:
        ValueError: ``steps`` is not at least 1, or there is no start.

    Examples:
        >>> import torch
        >>> from torchrl_osr.lab.dynamics import imagine, termination
        >>> from torchrl_osr.lab.dynamics import DynamicsEnsemble
        >>> model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=2)
        >>> starts = torch.zeros(4, 11)
        >>> starts[:, 0] = 1.25
        >>> rows, refused = imagine(
        ...     model, lambda state: torch.rand(len(state), 3), starts, steps=5,
        ...     terminated=termination("Hopper-v5"))
        >>> rows["next", "observation"].shape[-1], refused
        (11, 0)
    """
    check_positive("steps", steps, minimum=1)
    if not len(starts):
        raise ValueError("There is no state to start from.")
    state, refused, taken = starts, 0, []
    for step in range(steps):
        action = policy(state)
        mean, scale = prediction = model.predict(state, action)
        apart = model.disagreement(mean)
        uncertainty = largest_deviation(scale if units is None else scale * units)
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
                "uncertainty": uncertainty.unsqueeze(-1),
            },
            [len(state)],
        )
        refused += int((~known).sum())
        taken.append(row[known])
        state = following[known & ~ended.squeeze(-1)]
        if not len(state):
            break
    return Imagined(torch.cat(taken), refused)


class Expected(NamedTuple):
    """What each network expects of a policy, ``T`` steps on.

    Attributes:
        reward: of each step, 0 after the end, ``[T, E B]``, the first network's first.
        alive: whether the task goes on after each step, bool ``[T, E B]``.
        state: the last one, or the one before the end, ``[E B, S]``.
    """

    reward: Tensor
    alive: Tensor
    state: Tensor


@torch.no_grad()
def expect(
    networks: EliteNetworks,
    policy: Callable[[Tensor, int], Tensor],
    starts: Tensor,
    *,
    steps: int,
    terminated: Termination = never,
) -> Expected:
    """Roll each network out by itself, with its mean predictions.

    Nothing is drawn: :func:`imagine` does. A prediction that is not finite ends the
    task, too, without a reward.

    Args:
        networks: of the dynamics, ``E``.
        policy: maps states ``[E B, S]``, the first network's first, and the number of
            the step to actions ``[E B, A]``.
        starts: first states ``[B, S]``.

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
        action = policy(state, step)
        rows = number, len(starts), -1
        change = networks(state.view(rows), action.reshape(rows)).flatten(0, 1)
        going = going & change.isfinite().all(-1)
        reward[step] = change[:, -1].where(going, 0.0)
        following = state + change[:, :-1]
        going = going & ~terminated(following)
        alive[step] = going
        # What has fallen must not grow until it overflows.
        state = torch.where(going.unsqueeze(-1), following, state)
        if not going.any():
            break
    return Expected(reward, alive, state)


def any_action(model: DynamicsEnsemble) -> Callable[[Tensor], Tensor]:
    """A policy whose actions are uniform in [-1, 1]."""

    def policy(state: Tensor) -> Tensor:
        size = len(state), model.action_dim
        return 2 * torch.rand(size, device=state.device) - 1

    return policy


def disturbed(
    model: DynamicsEnsemble, starts: Tensor, *, steps: int, **options: Any
) -> Tensor:
    """States that random actions lead to in a model, beside the data but in reach.

    Args:
        model: of the dynamics.
        starts: states ``[B, S]`` from which each motor is at random in [-1, 1].

    Keyword Args:
        steps: of it, at most.
        options: ``terminated``, ``max_disagreement`` and ``halt_reward`` of
            :func:`imagine`.

    Returns:
        ``[B, S]``, drawn with replacement from all states in which the task goes on
        after 1 to ``steps`` such steps.

    Raises:
        ValueError: there is none.
    """
    rows, _ = imagine(model, any_action(model), starts, steps=steps, **options)
    following = rows["next", "observation"][~rows["next", "done"].squeeze(-1)]
    if not len(following):
        raise ValueError("no state is left after a random action: train the model.")
    found: Tensor = following[torch.randint(len(following), [len(starts)])]
    return found


def imagine_backwards(
    model: DynamicsEnsemble,
    policy: Callable[[Tensor], Tensor],
    ends: Tensor,
    *,
    terminated: Termination = never,
    **options: Any,
) -> Imagined:
    """Transitions that lead into given states, and on to where these came from.

    "Offline Reinforcement Learning with Reverse Model-based Imagination" (ROMI),
    https://arxiv.org/abs/2110.00188. Rows from a state in which the task has ended
    already are refused: nobody acts there.

    Args:
        model: trained on :func:`turned` rows: it predicts from a next state and the
            action the state before.
        policy: maps next states ``[B, S]`` to actions ``[B, A]`` that led there.
        ends: next states of the first rows, ``[B, S]``, in which the task goes on.

    Keyword Args:
        terminated: as in :func:`imagine`. Default: never.
        options: all others of :func:`imagine`.

    Returns:
        The rows, in the direction of time; none is terminated.
    """
    rows, refused = imagine(model, policy, ends, terminated=terminated, **options)
    acted = ~rows["next", "terminated"].squeeze(-1)
    return Imagined(turned(rows[acted]), refused + int((~acted).sum()))


def turned(rows: TensorDict) -> TensorDict:
    """The same transitions with state and next state exchanged."""
    following = rows.select(("next", "observation")).rename_key_(
        ("next", "observation"), "observation"
    )
    before = rows.select("observation").rename_key_(
        "observation", ("next", "observation")
    )
    return rows.copy().update(following).update(before)
