"""Distance to the data, survival, and return to the data after a disturbance.

Shapes: ``N`` rows of the data, ``M`` states, ``S`` observation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data import observation_statistics
from torchrl_osr.policy.monitor import distance_to

NUM_NEIGHBORS, MAX_REFERENCE = 10, 20_000
MAX_HELD_OUT = 2_000  # and at most a fifth of the data
ROWS_AT_A_TIME = 64  # more do not fit into the processor's cache and are slower

STEPS_AFTER = 100
"""An episode without a fall for so many steps after a disturbance counts as alive."""


class DataDistance:
    """Measure the mean distance to the 10 nearest states of the data.

    They are the nearest of a random subset of 20,000, in standard deviations of the
    data. A state counts as in the data up to :attr:`threshold`, which 95 % of held-out
    states are within.

    Args:
        data: transitions ``[N]`` with raw ``observation`` ``[N, S]``.

    Keyword Args:
        seed: of the random subset and of the held-out states. Default 0.
    """

    def __init__(self, data: TensorDictBase, *, seed: int = 0) -> None:
        held_out = min(MAX_HELD_OUT, len(data) // 5)
        if len(data) - held_out < NUM_NEIGHBORS or not held_out:
            raise ValueError(f"distances need at least 12 rows, got {len(data)}.")
        loc, scale = observation_statistics(data)
        self._loc, self._scale = loc.cpu().double(), scale.cpu().double()
        order = torch.randperm(len(data), generator=torch.Generator().manual_seed(seed))
        states = data["observation"].cpu()
        self._states = self._standard(states[order[held_out:][:MAX_REFERENCE]])
        others = self(states[order[:held_out]]).double()
        self.threshold = float(torch.quantile(others, 0.95))

    def __call__(self, observation: Tensor) -> Tensor:
        """Return the distances of raw observations ``[M, S]``, float32 ``[M]``."""
        # Double: the difference of two near states cancels the digits of float32.
        chunks = torch.split(self._standard(observation.cpu()), ROWS_AT_A_TIME)
        distances = [distance_to(each, self._states, NUM_NEIGHBORS) for each in chunks]
        return torch.cat(distances).float()

    def _standard(self, observation: Tensor) -> Tensor:
        return (observation.double() - self._loc) / self._scale


@dataclass
class Trajectory:
    """Observations ``[S]`` and flags of one episode: of the reset, then of each step.

    ``terminated`` is whether it ended by a fall: not at the time limit or a goal.
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
        return first, first + [*self.disturbed[first:], False].index(False) - 1

    def alive_after(self, end: int) -> bool | None:
        """Return whether it stands :data:`STEPS_AFTER` entries after ``end``.

        ``None`` if the time limit came first.
        """
        later = len(self.disturbed) - 1 - end
        if self.terminated and later <= STEPS_AFTER:
            return False
        return True if later >= STEPS_AFTER else None

    def steps_back(self, end: int, distance: DataDistance) -> int | None:
        """Return the steps from ``end`` to the first state in the data, if any."""
        # The state of a fall does not count.
        rows = self.observations[end : -1 if self.terminated else None]
        for first in range(0, len(rows), STEPS_AFTER):  # most are back soon
            chunk = torch.from_numpy(np.stack(rows[first:][:STEPS_AFTER]))
            within = distance(chunk).double() <= distance.threshold
            if within.any():
                return first + int(within.int().argmax())
        return None


def measure_recovery(
    disturbed: Trajectory, clean: Trajectory, distance: DataDistance
) -> dict[str, Any] | None:
    """Measure survival and recovery after the first disturbance of an episode.

    Returns:
        ``None`` if the disturbance never acted. Otherwise ``"survived_knock"``: no fall
        until its end. ``"alive_after"``: nor within 100 steps after it (``None``: the
        time limit came first). ``"clean_alive_after"``: the same of the undisturbed
        episode. ``"recovery_steps"``: steps until the state is in the data (``None``:
        the episode ended before).
    """
    block = disturbed.disturbance()
    if block is None:
        return None
    end, last = block[1], len(disturbed.disturbed) - 1
    return {
        "survived_knock": not (disturbed.terminated and last == end),
        "alive_after": disturbed.alive_after(end),
        "clean_alive_after": clean.alive_after(end),
        "recovery_steps": disturbed.steps_back(end, distance),
    }
