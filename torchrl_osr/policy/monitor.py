"""Distance of a state to the data, and an alarm with a stated rate of false alarms.

Shapes: ``N`` rows of the data, ``B`` batch, ``K`` kept states, ``S`` observation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

LIMIT = 1e6  # of a standardised entry: its square is still a float32
SMALLEST_SCALE = 1e-3  # of an entry that is constant in the data


def distance_to(rows: Tensor, states: Tensor, num_neighbors: int = 1) -> Tensor:
    """Return the mean distance ``[B]`` of rows to their nearest states ``[K, S]``.

    Squares are a matrix product: in float32, a distance below a thousandth of the rows'
    length has no digits. Standardise both.
    """
    squares = nn.functional.linear(rows, -2 * states, states.square().sum(-1))
    nearest = squares.amin(-1, keepdim=True)  # much faster than topk
    if num_neighbors > 1:
        nearest = squares.topk(num_neighbors, largest=False).values
    nearest = nearest + rows.square().sum(-1, keepdim=True)
    return nearest.clamp_min(0).sqrt().mean(-1)


def conformal_threshold(scores: Tensor, rate: float) -> float:
    r"""Return the threshold that a new score exceeds with probability at most ``rate``.

    It is the :math:`\lceil (n + 1)(1 - \text{rate}) \rceil`-th smallest of ``n``
    scores, which must be exchangeable with the new one. Source: "A Gentle Introduction
    to Conformal Prediction", https://arxiv.org/abs/2107.07511, section 1.

    Raises:
        ValueError: there are too few scores for this rate.

    Examples:
        >>> conformal_threshold(torch.arange(1.0, 41.0), rate=0.05)
        39.0
    """
    if not 0 < rate < 1:
        raise ValueError(
            f"the rate of false alarms must be within 0 and 1, got {rate}."
        )
    # Rounded, as 1 - 0.9 is not quite 0.1.
    needed = math.ceil(round(1 / rate, 9)) - 1
    if len(scores) < needed:
        raise ValueError(
            f"false alarms in {rate:.3g} of all episodes need {needed} episodes to "
            f"calibrate on, and there are {len(scores)}. Record more, or ask for a "
            f"rate of at least {math.ceil(1000 / (len(scores) + 1)) / 1000}."
        )
    place = math.ceil(round((len(scores) + 1) * (1 - rate), 9))
    return float(scores.sort().values[place - 1])


class DataMonitor(nn.Module):
    r"""Score how far a state is from the data, and raise an alarm beyond a threshold.

    .. math::
        d(s) = \min_k \lVert \sigma^{-1} (s - s_k) \rVert_2

    with a random subset :math:`s_k` of the states and their standard deviation
    :math:`\sigma` in each dimension. :func:`fit_monitor` makes one.

    As a module it maps observations ``[B, S]`` to scores ``[B]`` and alarms, bool
    ``[B]``. NaN has an infinite score; NaN and infinity raise an alarm.

    Attributes:
        record: sizes, the rate of false alarms, and the number of episodes behind it.
        loc, scale: of the data, ``[S]``.
        states: standardised, ``[K, S]``.
        threshold: the largest score without an alarm, ``[]``.
    """

    loc: Tensor
    scale: Tensor
    states: Tensor
    threshold: Tensor

    def __init__(self, record: Mapping[str, Any]) -> None:
        super().__init__()
        self.record = dict(record)
        count, size = record["num_states"], record["observation_size"]
        shapes = {"loc": [size], "scale": [size], "states": [count, size]}
        for name, shape in (shapes | {"threshold": []}).items():
            self.register_buffer(name, torch.zeros(shape))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        rows = (observation.to(self.loc.dtype) - self.loc) / self.scale
        score = distance_to(rows.clamp(-LIMIT, LIMIT), self.states)
        score = torch.where(score.isnan(), math.inf, score)
        return score, score > self.threshold

    @torch.no_grad()
    def calibrate(
        self,
        observation: Tensor,
        episode: Tensor,
        counts: Tensor | None = None,
        *,
        false_alarms: float = 0.05,
    ) -> None:
        """Set the threshold by conformal prediction on the largest score of an episode.

        The promise holds for new episodes that are exchangeable with these. Those of a
        new policy are not exchangeable with a log: once you have undisturbed episodes
        of the policy, calibrate on them.

        Args:
            observation: of episodes that :attr:`states` are not from, ``[N, S]``.
            episode: number of each row's episode, int ``[N]``.
            counts: whether an alarm in a row would be false, bool ``[N]``. Default:
                all.

        Keyword Args:
            false_alarms: largest share of episodes with a false alarm. Default 0.05.
                A ValueError if there are too few episodes for it.
        """
        if counts is not None:  # an episode without such rows promises nothing
            observation, episode = observation[counts], episode[counts]
        score = torch.cat([self(rows)[0] for rows in torch.split(observation, 4096)])
        if score.isinf().any() or observation.isinf().any():
            raise ValueError("the observations have NaN or infinity: leave these out.")
        numbers, index = torch.unique(episode, return_inverse=True)
        largest = score.new_full([len(numbers)], -math.inf)
        largest = largest.scatter_reduce(0, index, score, "amax")
        self.threshold.fill_(conformal_threshold(largest, false_alarms))
        self.record |= {"false_alarms": false_alarms, "episodes": len(numbers)}


def fit_monitor(
    observation: Tensor,
    episode: Tensor,
    counts: Tensor | None = None,
    *,
    false_alarms: float | None = 0.05,
    num_states: int = 1000,
    seed: int = 0,
) -> DataMonitor:
    """Fit a monitor to one half of the episodes, and calibrate it on the other half.

    Args:
        observation: of all rows, ``[N, S]``.
        episode: number of each row's episode, int ``[N]``.
        counts: whether a row is part of the data, bool ``[N]``. Leave out the rows
            before a fall: falls that the data show would raise no alarm. Default: all.

    Keyword Args:
        false_alarms: see :meth:`DataMonitor.calibrate`. Default 0.05. ``None`` leaves
            the calibration to you.
        num_states: ``K``, at most. Default 1000.
        seed: of the halves and of the subset. Default 0.

    Examples:
        >>> rows = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
        >>> monitor = fit_monitor(rows, torch.arange(1000) // 10)
        >>> score, alarm = monitor(torch.tensor([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]]))
        >>> alarm.tolist()
        [False, True]
    """
    generator = torch.Generator().manual_seed(seed)
    counts = torch.ones_like(episode, dtype=torch.bool) if counts is None else counts
    numbers = torch.unique(episode)
    order = numbers[torch.randperm(len(numbers), generator=generator, device="cpu")]
    held_out = torch.isin(episode, order[len(order) // 2 :])
    known = (~held_out & counts).nonzero()[:, 0]
    if not len(known):
        if false_alarms is not None:  # there may be too few episodes
            conformal_threshold(torch.zeros(len(order) - len(order) // 2), false_alarms)
        raise ValueError("no rows to fit: it needs two episodes, and rows that count.")
    data = observation[known].float()
    chosen = torch.randperm(len(data), generator=generator, device="cpu")[:num_states]
    size = {"num_states": len(chosen), "observation_size": data.shape[-1]}
    monitor = DataMonitor(size).to(data)
    variance, loc = torch.var_mean(data.double(), 0, correction=0)
    monitor.loc.copy_(loc)
    monitor.scale.copy_(variance.sqrt().clamp_min(SMALLEST_SCALE))
    monitor.states.copy_((data[chosen] - monitor.loc) / monitor.scale)
    rest = (each[held_out] for each in (observation, episode, counts))
    if false_alarms is not None:
        monitor.calibrate(*rest, false_alarms=false_alarms)
    return monitor
