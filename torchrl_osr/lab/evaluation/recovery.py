"""Survival and return to the data after a disturbance that ends.

Entry 0 of a trajectory is the reset, entry ``i + 1`` is step ``i``. Offsets count from
the last entry in which the disturbance acted, offset 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_osr.lab.evaluation.data_distance import DataDistance

STEPS_BEFORE, STEPS_AFTER = 10, 100
"""Steps around the end of a disturbance over which distances are averaged.

An episode without a fall until :data:`STEPS_AFTER` steps after it counts as alive.
"""


@dataclass
class Trajectory:
    """One recorded episode.

    Attributes:
        observations: of the reset and of each step, float32 ``[S]`` each.
        disturbed: ``info["disturbed"]`` of each.
        terminated: whether it ended by a fall: not at the time limit or a goal.
    """

    observations: list[NDArray[np.float32]] = field(default_factory=list)
    disturbed: list[bool] = field(default_factory=list)
    terminated: bool = False

    def disturbance(self) -> tuple[int, int] | None:
        """First and last entry of the first disturbance; ``None`` if there is none."""
        if True not in self.disturbed:
            return None
        first = self.disturbed.index(True)
        rest = self.disturbed[first:]
        return first, first + (rest.index(False) if False in rest else len(rest)) - 1

    def alive_after(self, end: int) -> bool | None:
        """Whether there is no fall until :data:`STEPS_AFTER` entries after ``end``.

        ``None`` if the time limit came first.
        """
        later = len(self.disturbed) - 1 - end
        if self.terminated and later <= STEPS_AFTER:
            return False
        return True if later >= STEPS_AFTER else None


class Recorder:
    """Keep the trajectories of an evaluation's episodes, as its ``watch``."""

    def __init__(self, num_episodes: int) -> None:
        self.trajectories = [Trajectory() for _ in range(num_episodes)]

    def __call__(
        self, episode: int, observation: Any, terminated: bool, info: dict[str, Any]
    ) -> None:
        """Record a reset or a step."""
        trajectory = self.trajectories[episode]
        # astype copies: an environment may write into the same array again.
        trajectory.observations.append(observation.astype(np.float32))
        trajectory.disturbed.append(bool(info.get("disturbed", False)))
        trajectory.terminated = bool(terminated) and not info.get("success", False)


def measure_recovery(
    disturbed: Trajectory, clean: Trajectory, distance: DataDistance
) -> dict[str, Any] | None:
    """Survival and recovery of one pair of episodes.

    Returns:
        ``None`` if the disturbance never acted. Else the last step in which it acted,
        ``"ended_at"``; whether the episode had not fallen by then,
        ``"survived_knock"``, nor :data:`STEPS_AFTER` steps later, ``"alive_after"``
        (``None``: the time limit came first), and the same for the undisturbed episode,
        ``"clean_alive_after"``; the steps from the end of the disturbance until the
        distance to the data is within the threshold, ``"recovery_steps"`` (``None``:
        the episode ended before); and distances in units of the threshold from
        :data:`STEPS_BEFORE` steps before that end to :data:`STEPS_AFTER` after it,
        ``"distance"`` and ``"clean_distance"`` (NaN: the episode has no such step).
    """
    block = disturbed.disturbance()
    if block is None:
        return None
    end, last = block[1], len(disturbed.disturbed) - 1
    curve = _around(disturbed, end, distance)
    steps = _first_within(curve[STEPS_BEFORE:])
    if steps is None:
        later = _relative(disturbed.observations[end + STEPS_AFTER + 1 :], distance)
        steps = _first_within(later, STEPS_AFTER + 1)
    # The state of the fall itself does not count as recovered.
    if disturbed.terminated and steps == last - end:
        steps = None
    return {
        "ended_at": max(end - 1, 0),
        "survived_knock": not (disturbed.terminated and last == end),
        "alive_after": disturbed.alive_after(end),
        "clean_alive_after": clean.alive_after(end),
        "recovery_steps": steps,
        "distance": curve,
        "clean_distance": _around(clean, end, distance),
    }


def _around(
    trajectory: Trajectory, end: int, distance: DataDistance
) -> NDArray[np.float64]:
    """Distances around entry ``end``, NaN where there is no such entry."""
    curve = np.full(STEPS_BEFORE + 1 + STEPS_AFTER, np.nan)
    start = max(end - STEPS_BEFORE, 0)
    there = trajectory.observations[start : end + STEPS_AFTER + 1]
    first = start - end + STEPS_BEFORE
    curve[first : first + len(there)] = _relative(there, distance)
    return curve


def _relative(
    observations: Sequence[NDArray[np.float32]], distance: DataDistance
) -> NDArray[np.float64]:
    """Distances in units of the threshold."""
    if not observations:
        return np.empty(0)
    rows = torch.from_numpy(np.stack(observations))
    relative: NDArray[np.float64] = distance(rows).double().numpy()
    return relative / distance.threshold


def _first_within(curve: NDArray[np.float64], offset: int = 0) -> int | None:
    """First entry within the threshold, counted from ``offset``."""
    within = np.flatnonzero(curve <= 1)
    return offset + int(within[0]) if within.size else None
