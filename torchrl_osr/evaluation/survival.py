"""How many survive a disturbance: shares with intervals, and controllers in pairs.

Shapes: ``E`` episodes; entry ``e`` of every list belongs to the same start state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_osr.evaluation.recovery import Trajectory
from torchrl_osr.evaluation.statistics import wilson_interval


def steps_alive(trajectory: Trajectory, moment: int, steps: int) -> int:
    """Return for how many steps an episode went on without a fall, at most ``steps``.

    Args:
        trajectory: that goes on for ``steps``, unless it ended by a fall.
        moment: the entry to count from.
        steps: how far to look.

    Raises:
        ValueError: if it was broken off before.
    """
    later = trajectory.last - moment
    if later < steps and not trajectory.terminated:
        raise ValueError(f"broken off {later} steps after entry {moment}, not {steps}.")
    # The last entry of a fallen one is the fall.
    return max(min(later - trajectory.terminated, steps), 0)


@dataclass(frozen=True)
class Survival:
    """What became of one controller's episodes, one entry an episode.

    Attributes:
        horizons: steps after the disturbance to be counted at, ascending.
        returns: sum of rewards, of all steps that were played, ``[E]``.
        alive: steps without a fall after it, at most the last horizon, ``[E]``.
        alive_clean: the same without it, after the same moment, ``[E]``.
        steps_back: until back in the data, ``None`` if never, ``[E]``.
    """

    horizons: tuple[int, ...]
    returns: list[float]
    alive: list[int]
    alive_clean: list[int]
    steps_back: list[int | None]

    @property
    def up(self) -> list[bool]:
        """Whether it had not fallen at the last horizon, ``[E]``."""
        return [steps >= self.horizons[-1] for steps in self.alive]

    def count(self, horizon: int, *, clean: bool = False) -> int:
        """Return how many had not fallen ``horizon`` steps later."""
        alive = self.alive_clean if clean else self.alive
        return sum(steps >= horizon for steps in alive)


def discordant(ours: Sequence[bool], theirs: Sequence[bool]) -> tuple[int, int]:
    """Return in how many pairs only the first is true, and only the second."""
    pairs = list(zip(ours, theirs, strict=True))
    return pairs.count((True, False)), pairs.count((False, True))


def survival_table(controllers: Mapping[str, Survival]) -> str:
    """Return a table with one line a controller, the first being the reference.

    The last column counts pairs at the last horizon: in how many only this controller
    was up, and in how many only the reference.

    Args:
        controllers: by name; the same disturbed episodes each.
    """
    reference = next(iter(controllers.values()))
    total, last = len(reference.alive), reference.horizons[-1]
    titles = [f"up after {each}" for each in reference.horizons]
    titles += ["95 % interval", f"undisturbed {last}", "back in data", "only it/first"]
    rows = [["", *titles]]
    for name, each in controllers.items():
        low, high = wilson_interval(each.count(last), total)
        back = [steps for steps in each.steps_back if steps is not None]
        steps = f" in {np.median(back):.0f}" if back else ""
        ours, theirs = discordant(each.up, reference.up)
        row = [name, *(str(each.count(horizon)) for horizon in each.horizons)]
        row += [
            f"{100 * low:.0f}-{100 * high:.0f} %",
            str(each.count(last, clean=True)),
        ]
        rows.append(
            [
                *row,
                f"{len(back)}{steps}",
                "" if each is reference else f"{ours}/{theirs}",
            ]
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *cells in rows:
        pairs = zip(cells, widths[1:], strict=True)
        aligned = [cell.rjust(width) for cell, width in pairs]
        lines.append("  ".join(["", first.ljust(widths[0]), *aligned]).rstrip())
    return "\n".join(lines)
