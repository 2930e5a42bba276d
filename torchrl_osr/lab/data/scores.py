"""D4RL reference returns, and scores normalised by them.

A normalised score is 0 for the return of D4RL's uniformly random policy and 100 for
the return of its expert. The constants are those of ``d4rl/infos.py`` in
https://github.com/Farama-Foundation/D4RL.

They were measured on the v2 tasks of ``mujoco-py``. Gymnasium's v5 tasks share the
scale, not the task: do not put the two in one column.

In the mazes the return is 1 where the goal was reached and 0 where it was not, and
D4RL's references of AntMaze are 0 and 1: the normalised score is the success rate in
percent. We take them for the point as well.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np


class ReferenceReturns(NamedTuple):
    """Mean undiscounted episode returns of a random and of an expert policy."""

    random: float
    expert: float

    def score(self, episode_return: Any) -> Any:
        """Normalised scores in percent, of a number or an array of returns."""
        above = np.asarray(episode_return, dtype=np.float64) - self.random
        score = 100.0 * above / (self.expert - self.random)
        return float(score) if np.ndim(episode_return) == 0 else score


REFERENCE_RETURNS: dict[str, ReferenceReturns] = {
    "hopper": ReferenceReturns(random=-20.272305, expert=3234.3),
    "halfcheetah": ReferenceReturns(random=-280.178953, expert=12135.0),
    "walker2d": ReferenceReturns(random=1.629008, expert=4592.3),
} | {
    f"{body}maze-{size}": ReferenceReturns(random=0.0, expert=1.0)
    for body in ("point", "ant")
    for size in ("umaze", "medium", "large")
}
"""D4RL's reference returns by short environment name."""


def reference_returns(
    env_name: str,
    random_return: float | None = None,
    expert_return: float | None = None,
) -> ReferenceReturns | None:
    """Reference returns of a task, ``None`` if there are none.

    The arguments are for a task that has none of D4RL's: both returns, or neither for
    raw returns.

    Examples:
        >>> from torchrl_osr.lab.data import reference_returns
        >>> reference_returns("halfcheetah").score(12135.0)
        100.0
    """
    low, high = random_return, expert_return
    if low is None and high is None:
        return REFERENCE_RETURNS.get(env_name)
    known = env_name in REFERENCE_RETURNS
    if known or low is None or high is None or not 0 < high - low < math.inf:
        raise ValueError(
            f"env.random_return={low} and env.expert_return={high} of {env_name}: "
            "expected two finite numbers, the expert's above the random policy's, and "
            "none for a task with D4RL's references."
        )
    return ReferenceReturns(low, high)
