"""Statistics of a data set, and scores normalised by D4RL's reference returns.

A normalised score is 0 for the return of D4RL's uniformly random policy and 100 for
the return of its expert (``d4rl/infos.py``), measured on the v2 tasks of ``mujoco-py``.
In the mazes it is the success rate in percent.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl import torchrl_logger

from torchrl_osr.lab.data.environment import MAZE_IDS

# A constant observation entry would otherwise be divided by zero, and one that barely
# moves would drown the others. TD3+BC adds 1e-3 to the standard deviation; as a floor
# it leaves all larger entries exactly unit-variance.
MIN_OBSERVATION_SCALE = 1e-3


def observation_statistics(data: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of each observation entry, ``[S]``.

    The deviation is at least 0.001; a logged warning names entries that vary less.
    """
    observation = data.get("observation")
    variance, loc = torch.var_mean(observation.double(), dim=0, correction=0)
    scale = variance.sqrt()
    if small := (scale < MIN_OBSERVATION_SCALE).nonzero()[:, 0].tolist():
        torchrl_logger.warning(
            f"{len(small)} observation entries have a standard deviation below "
            f"{MIN_OBSERVATION_SCALE}, by which they are divided: {small[:5]}."
        )
    scale = scale.clamp_min(MIN_OBSERVATION_SCALE)
    return loc.to(observation.dtype), scale.to(observation.dtype)


class ReferenceReturns(NamedTuple):
    """Mean undiscounted episode returns of a random and of an expert policy."""

    random: float
    expert: float

    def score(self, episode_return: Any) -> Any:
        """Return normalised scores in percent for one return or an array."""
        return 100.0 * (episode_return - self.random) / (self.expert - self.random)


REFERENCE_RETURNS: dict[str, ReferenceReturns] = {
    "hopper": ReferenceReturns(random=-20.272305, expert=3234.3),
    "halfcheetah": ReferenceReturns(random=-280.178953, expert=12135.0),
    "walker2d": ReferenceReturns(random=1.629008, expert=4592.3),
} | dict.fromkeys(MAZE_IDS, ReferenceReturns(random=0.0, expert=1.0))
"""D4RL's reference returns by short environment name."""


def reference_returns(
    env_name: str,
    random_return: float | None = None,
    expert_return: float | None = None,
) -> ReferenceReturns | None:
    """Return the reference returns of a task, ``None`` if there are none.

    The arguments are for tasks without D4RL's: both, or neither for raw returns.
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
