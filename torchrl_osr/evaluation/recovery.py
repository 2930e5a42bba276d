"""Survival and return to the data after a transient disturbance.

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

from torchrl_osr.evaluation.data_distance import DataDistance

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
        terminated: whether the episode ended by a fall, neither by the time limit nor
            at a goal.
    """

    observations: list[NDArray[np.float32]] = field(default_factory=list)
    disturbed: list[bool] = field(default_factory=list)
    terminated: bool = False

    @property
    def last(self) -> int:
        """The last entry."""
        return len(self.disturbed) - 1


class Recorder:
    """Keeps the trajectories of an evaluation, as its ``watch``.

    Args:
        num_episodes: of the evaluation.

    Attributes:
        trajectories: one for each episode.
    """

    def __init__(self, num_episodes: int) -> None:
        self.trajectories = [Trajectory() for _ in range(num_episodes)]

    def __call__(
        self,
        episode: int,
        observation: NDArray[Any],
        terminated: bool,
        info: dict[str, Any],
    ) -> None:
        """Append the results of a reset or a step."""
        trajectory = self.trajectories[episode]
        # astype copies: an environment may write into the same array again.
        trajectory.observations.append(observation.astype(np.float32))
        trajectory.disturbed.append(bool(info.get("disturbed", False)))
        trajectory.terminated = bool(terminated) and not info.get("success", False)


class DistanceCurve:
    """Mean distance to the data around the end of a disturbance.

    Offsets go from :data:`STEPS_BEFORE` steps before to :data:`STEPS_AFTER` after it.

    Attributes:
        count: episodes behind each mean, those that have that step.
    """

    def __init__(self) -> None:
        size = STEPS_BEFORE + 1 + STEPS_AFTER
        self._total = np.zeros(size)
        self.count = np.zeros(size, dtype=np.int64)

    def add(self, curve: NDArray[np.float64], offset: int) -> None:
        """Add an episode's distances from ``offset`` on."""
        place = slice(offset + STEPS_BEFORE, offset + STEPS_BEFORE + len(curve))
        self._total[place] += curve
        self.count[place] += 1

    def mean(self) -> list[float | None]:
        """Mean at each offset, ``None`` where no episode has one."""
        pairs = zip(self._total, self.count, strict=True)
        return [float(total / count) if count else None for total, count in pairs]


@dataclass
class Recovery:
    """Survival and recovery after a transient disturbance, one entry an episode.

    All entries of an episode without the disturbance are ``None``.

    Attributes:
        ended_at: last step in which the disturbance acted.
        survived: had not fallen by then.
        alive_after: had not fallen :data:`STEPS_AFTER` steps later; ``None`` where the
            time limit came first.
        clean_alive_after: the same for the undisturbed episodes of the pairs: some
            would have fallen anyway.
        steps: from its end until the distance to the data is within the threshold, 0 if
            it never left; ``None`` where the episode ended before.
        distance: in units of the threshold, as far as the episodes go.
        clean_distance: of the undisturbed episodes, at the same steps.
    """

    ended_at: list[int | None] = field(default_factory=list)
    survived: list[bool | None] = field(default_factory=list)
    alive_after: list[bool | None] = field(default_factory=list)
    clean_alive_after: list[bool | None] = field(default_factory=list)
    steps: list[int | None] = field(default_factory=list)
    distance: DistanceCurve = field(default_factory=DistanceCurve)
    clean_distance: DistanceCurve = field(default_factory=DistanceCurve)


def disturbed_at(trajectory: Trajectory) -> int | None:
    """Step of the first disturbance, from 0; ``None`` if there was none.

    A disturbance of the start state counts as step 0.
    """
    block = _first_block(trajectory.disturbed)
    return None if block is None else max(block[0] - 1, 0)


def measure_recovery(
    disturbed: Sequence[Trajectory], clean: Sequence[Trajectory], distance: DataDistance
) -> Recovery:
    """Survival, recovery and distances of the episodes under one disturbance.

    Args:
        disturbed: its episodes.
        clean: the undisturbed ones of the pairs.
        distance: to the data, with its threshold.
    """
    recovery = Recovery()
    for trajectory, pair in zip(disturbed, clean, strict=True):
        block = _first_block(trajectory.disturbed)
        if block is None:
            for each in (recovery.ended_at, recovery.survived, recovery.steps):
                each.append(None)
            recovery.alive_after.append(None)
            recovery.clean_alive_after.append(None)
            continue
        end = block[1]
        recovery.ended_at.append(max(end - 1, 0))
        fell_in_it = trajectory.terminated and trajectory.last == end
        recovery.survived.append(not fell_in_it)
        recovery.alive_after.append(_alive_after(trajectory, end))
        recovery.clean_alive_after.append(_alive_after(pair, end))
        start = max(end - STEPS_BEFORE, 0)
        window = slice(start, end + STEPS_AFTER + 1)
        curve = _relative(trajectory.observations[window], distance)
        recovery.distance.add(curve, start - end)
        clean_curve = _relative(pair.observations[window], distance)
        recovery.clean_distance.add(clean_curve, start - end)
        back = _first_within(curve[end - start :])
        if back is None:
            later = _relative(trajectory.observations[window.stop :], distance)
            back = _first_within(later, STEPS_AFTER + 1)
        # The state of the fall itself does not count as recovered.
        fell_there = trajectory.terminated and back == trajectory.last - end
        recovery.steps.append(None if fell_there else back)
    return recovery


def _alive_after(trajectory: Trajectory, end: int) -> bool | None:
    """Whether there is no fall until :data:`STEPS_AFTER` steps after ``end``."""
    fell_within = trajectory.terminated and trajectory.last <= end + STEPS_AFTER
    if fell_within:
        return False
    return True if trajectory.last >= end + STEPS_AFTER else None


def _first_block(disturbed: Sequence[bool]) -> tuple[int, int] | None:
    """First and last entry of the first disturbance."""
    if True not in disturbed:
        return None
    first = last = disturbed.index(True)
    while last + 1 < len(disturbed) and disturbed[last + 1]:
        last += 1
    return first, last


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
