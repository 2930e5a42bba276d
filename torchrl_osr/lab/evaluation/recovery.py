"""Survival and return to the data after a disturbance that ends.

Entry 0 of a trajectory is the reset, entry ``i + 1`` is step ``i``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_osr.lab.evaluation.data_distance import DataDistance

STEPS_AFTER = 100
"""An episode without a fall for so many steps after a disturbance counts as alive."""


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

    def record(self, observation: Any, terminated: bool, info: dict[str, Any]) -> None:
        """Append a reset or a step."""
        # astype copies: an environment may write into the same array again.
        self.observations.append(observation.astype(np.float32))
        self.disturbed.append(bool(info.get("disturbed", False)))
        self.terminated = bool(terminated) and not info.get("success", False)

    def disturbance(self) -> tuple[int, int] | None:
        """Return the first and last entry of the first disturbance, if there is one."""
        if True not in self.disturbed:
            return None
        first = self.disturbed.index(True)
        rest = self.disturbed[first:]
        return first, first + (rest.index(False) if False in rest else len(rest)) - 1

    def alive_after(self, end: int) -> bool | None:
        """Return whether it stands :data:`STEPS_AFTER` entries after ``end``.

        ``None`` if the time limit came first.
        """
        later = len(self.disturbed) - 1 - end
        if self.terminated and later <= STEPS_AFTER:
            return False
        return True if later >= STEPS_AFTER else None


def measure_recovery(
    disturbed: Trajectory, clean: Trajectory, distance: DataDistance
) -> dict[str, Any] | None:
    """Measure survival and recovery of one pair of episodes.

    Returns:
        ``None`` if the disturbance never acted. Else the last step in which it acted,
        ``"ended_at"``; whether the episode had not fallen by then,
        ``"survived_knock"``, nor 100 steps later, ``"alive_after"`` (``None``: the time
        limit came first); the same of the undisturbed episode,
        ``"clean_alive_after"``; and the steps from the end of the disturbance until the
        distance to the data is within the threshold, ``"recovery_steps"`` (``None``:
        the episode ended before).
    """
    block = disturbed.disturbance()
    if block is None:
        return None
    end, last = block[1], len(disturbed.disturbed) - 1
    steps = _steps_back(disturbed.observations[end:], distance)
    # The state of the fall itself does not count as recovered.
    if disturbed.terminated and steps == last - end:
        steps = None
    return {
        "ended_at": max(end - 1, 0),
        "survived_knock": not (disturbed.terminated and last == end),
        "alive_after": disturbed.alive_after(end),
        "clean_alive_after": clean.alive_after(end),
        "recovery_steps": steps,
    }


def _steps_back(
    observations: list[NDArray[np.float32]], distance: DataDistance
) -> int | None:
    """Return the number of the first observation within the threshold."""
    for first in range(0, len(observations), STEPS_AFTER):  # most are back soon
        rows = torch.from_numpy(np.stack(observations[first:][:STEPS_AFTER]))
        within = distance(rows).double() <= distance.threshold
        if within.any():
            return first + int(within.int().argmax())
    return None
