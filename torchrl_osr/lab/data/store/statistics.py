"""What is known of a data set in a few numbers.

Shapes: ``N`` transitions, ``S`` observation, ``E`` complete episodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl import torchrl_logger

# A constant observation entry would otherwise be divided by zero, and one that barely
# moves would be blown up until it drowns the others. 1e-3 is what TD3+BC adds to the
# standard deviation; as a floor it leaves all larger entries exactly unit-variance.
MIN_OBSERVATION_SCALE = 1e-3

ENTRIES_NAMED = 5

# Copied to float64 at a time: 90 MB of hopper.
ROWS_AT_A_TIME = 2**20


def observation_statistics(data: TensorDictBase) -> tuple[Tensor, Tensor]:
    r"""Mean and standard deviation of each observation entry.

    Accumulated in float64, since the float32 sum of a million rows loses digits. Rows
    are read in chunks, so that a memory-mapped set is not copied; chunks :math:`A` and
    :math:`B` are merged by Chan's formula, which cancels no digits:

    .. math::
        \sigma^2 = \frac{n_A \sigma_A^2 + n_B \sigma_B^2}{n_A + n_B}
            + \frac{n_A n_B}{(n_A + n_B)^2} (\bar x_B - \bar x_A)^2

    Args:
        data: transitions ``[N]`` with ``observation`` ``[N, S]``.

    Returns:
        ``loc`` ``[S]`` and ``scale`` ``[S]``. The scale is at least 0.001: what varies
        less is divided by that and keeps a deviation below 1. A logged warning names
        such entries, with their deviation.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.data import observation_statistics
        >>> rows = torch.tensor([[1.0, 5.0], [3.0, 5.0]])
        >>> data = TensorDict({"observation": rows}, batch_size=[2])
        >>> observation_statistics(data)
        (tensor([2., 5.]), tensor([1.0000, 0.0010]))
    """
    observation = data.get("observation")
    loc = torch.zeros_like(observation[0], dtype=torch.float64)
    variance, count = torch.zeros_like(loc), 0
    for rows in observation.split(ROWS_AT_A_TIME):
        chunk_variance, chunk_loc = torch.var_mean(rows.double(), dim=0, correction=0)
        total = count + len(rows)
        share = len(rows) / total
        delta = chunk_loc - loc
        variance = (1 - share) * (variance + share * delta**2) + share * chunk_variance
        loc = loc + share * delta
        count = total
    scale = variance.sqrt()
    if small := (scale < MIN_OBSERVATION_SCALE).nonzero()[:, 0].tolist():
        named = [f"{entry} ({scale[entry]:.2g})" for entry in small[:ENTRIES_NAMED]]
        rest = len(small) - len(named)
        torchrl_logger.warning(
            f"Observation entries have a standard deviation below "
            f"{MIN_OBSERVATION_SCALE} and are divided by {MIN_OBSERVATION_SCALE} when "
            f"standardised: {', '.join(named)}{f' and {rest} more' if rest else ''}."
        )
    scale = scale.clamp_min(MIN_OBSERVATION_SCALE)
    return loc.to(observation.dtype), scale.to(observation.dtype)


def sampled_observations(data: TensorDictBase, max_rows: int = 200_000) -> Tensor:
    """Observations ``[N, S]``, or of a larger set so many rows at random.

    Args:
        data: transitions ``[N]``.
        max_rows: rows that are returned, at most. Default: 200,000.
    """
    observation: Tensor = data.get("observation")
    if len(observation) <= max_rows:
        return observation
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    return observation[order[:max_rows].sort().values]


def describe_episodes(returns: ArrayLike, lengths: ArrayLike) -> dict[str, Any]:
    """Entries of a manifest about the episodes that were played to their end.

    Args:
        returns: of each episode, ``[E]``.
        lengths: in steps, ``[E]``.
    """
    returns, lengths = np.asarray(returns), np.asarray(lengths)
    return {
        "num_complete_episodes": len(returns),
        "return": _summary(returns),
        "episode_length": _summary(lengths),
        "episode_returns": returns.tolist(),
        "episode_lengths": lengths.tolist(),
    }


def _summary(values: NDArray[Any]) -> dict[str, float] | None:
    if not len(values):
        return None
    names = ("mean", "std", "min", "max")
    return {name: float(getattr(values, name)()) for name in names}
