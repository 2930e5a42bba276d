"""Distance of a state to the data.

Shapes: ``N`` rows of the data, ``M`` states, ``S`` observation, ``K`` neighbours.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data import observation_statistics

NUM_NEIGHBORS = 10
MAX_HELD_OUT = 2_000  # and at most a fifth of the data
ROWS_AT_A_TIME = 64  # more do not fit into the processor's cache and are slower


class DataDistance:
    r"""Measure the mean distance to the ``K = 10`` nearest states of the data.

    .. math::
        d(s) = \frac{1}{K} \sum_{k=1}^{K} \lVert \sigma^{-1} (s - s_{(k)}) \rVert_2

    with :math:`s_{(k)}` the ``k``-th nearest of a random subset of the states and
    :math:`\sigma` the data's standard deviation in each dimension. A state counts as
    in the data up to :attr:`threshold`, which 95 % of held-out states are within.

    Args:
        data: transitions ``[N]`` with raw ``observation`` ``[N, S]``.

    Keyword Args:
        max_reference: size of the subset, at most. Default 20,000.
        seed: of the random subset and of the held-out states. Default 0.

    Examples:
        >>> rows = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
        >>> from tensordict import TensorDict
        >>> distance = DataDistance(TensorDict({"observation": rows}, [1000]))
        >>> far = torch.tensor([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
        >>> (distance(far) <= distance.threshold).tolist()
        [True, False]
    """

    def __init__(
        self, data: TensorDictBase, *, max_reference: int = 20_000, seed: int = 0
    ) -> None:
        held_out = min(MAX_HELD_OUT, len(data) // 5)
        reference = min(max_reference, len(data) - held_out)
        if reference < NUM_NEIGHBORS or held_out < 1:
            raise ValueError(
                f"{len(data)} rows, max_reference={max_reference}: too few for "
                f"{NUM_NEIGHBORS} neighbours and a held-out state."
            )
        loc, scale = observation_statistics(data)
        self._loc, self._scale = loc.cpu().double(), scale.cpu().double()
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(data), generator=generator)
        # Of a set on disk, only these rows are read.
        states, others = (
            data[rows]["observation"].cpu()
            for rows in (order[held_out:][:reference], order[:held_out])
        )
        self._states = self._standard(states)
        self._squares = self._states.square().sum(-1)
        self.threshold = float(torch.quantile(self(others).double(), 0.95))

    def __call__(self, observation: Tensor) -> Tensor:
        """Return the distances of raw observations ``[M, S]``, float32 ``[M]``."""
        chunks = torch.split(self._standard(observation.cpu()), ROWS_AT_A_TIME)
        return torch.cat([self._distance(states) for states in chunks]).float()

    def _standard(self, observation: Tensor) -> Tensor:
        return (observation.double() - self._loc) / self._scale

    def _distance(self, states: Tensor) -> Tensor:
        # |s - r|^2 = |s|^2 + |r|^2 - 2 s r cancels digits where s and r are near:
        # double precision has enough of them, and takes a third longer.
        others = torch.addmm(self._squares, states, self._states.T, alpha=-2)
        # |s|^2 does not change which are near.
        near = others.topk(NUM_NEIGHBORS, largest=False, sorted=False).values
        squares = near + states.square().sum(-1, keepdim=True)
        return squares.clamp_min(0).sqrt().mean(-1)
