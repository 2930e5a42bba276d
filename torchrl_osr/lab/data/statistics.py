"""Statistics of a data set.

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

from torchrl_osr.lab.data.transitions import ROWS_AT_A_TIME

# A constant observation entry would otherwise be divided by zero, and one that barely
# moves would drown the others. TD3+BC adds 1e-3 to the standard deviation; as a floor
# it leaves all larger entries exactly unit-variance.
MIN_OBSERVATION_SCALE = 1e-3


def observation_statistics(data: TensorDictBase) -> tuple[Tensor, Tensor]:
    r"""Mean and standard deviation of each observation entry.

    Accumulated in float64 over chunks :math:`A` and :math:`B`, so that a memory-mapped
    set is not copied, by Chan's formula:

    .. math::
        \sigma^2 = \frac{n_A \sigma_A^2 + n_B \sigma_B^2}{n_A + n_B}
            + \frac{n_A n_B}{(n_A + n_B)^2} (\bar x_B - \bar x_A)^2

    Returns:
        ``loc`` ``[S]`` and ``scale`` ``[S]``. The scale is at least 0.001; a logged
        warning names entries that vary less.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.data import observation_statistics
        >>> rows = torch.tensor([[1.0, 5.0], [3.0, 5.0]])
        >>> observation_statistics(TensorDict({"observation": rows}, [2]))
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
        torchrl_logger.warning(
            f"{len(small)} observation entries have a standard deviation below "
            f"{MIN_OBSERVATION_SCALE} and are divided by that when standardised, the "
            f"first of them {small[:5]}."
        )
    scale = scale.clamp_min(MIN_OBSERVATION_SCALE)
    return loc.to(observation.dtype), scale.to(observation.dtype)


def sampled_observations(data: TensorDictBase, max_rows: int = 200_000) -> Tensor:
    """Observations ``[N, S]``, of a larger set ``max_rows`` at random."""
    observation: Tensor = data.get("observation")
    if len(observation) <= max_rows:
        return observation
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    return observation[order[:max_rows].sort().values]


def describe_episodes(returns: ArrayLike, lengths: ArrayLike) -> dict[str, Any]:
    """Entries of a manifest about complete episodes, by return and length ``[E]``."""
    returns, lengths = np.asarray(returns), np.asarray(lengths)
    return {
        "num_complete_episodes": len(returns),
        "return": _summary(returns),
        "episode_length": _summary(lengths),
        "episode_returns": returns.tolist(),
        "episode_lengths": lengths.tolist(),
    }


def _summary(values: NDArray[Any]) -> dict[str, float] | None:
    names = ("mean", "std", "min", "max")
    return {n: float(getattr(values, n)()) for n in names} if len(values) else None
