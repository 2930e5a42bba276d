"""The data's next action: what the following row of the same episode did.

Shapes: ``N`` transitions, ``B`` rows of them, ``A`` action.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data.store.statistics import ROWS_AT_A_TIME

# Two recordings of one state may differ by rounding, relative to its entries.
SAME_STATE = 1e-6


def next_action(data: TensorDictBase, rows: Tensor | None = None) -> Tensor:
    """Return the action of the row after each, 0 where an episode ends.

    Args:
        data: all transitions ``[N]`` in order of time, see :func:`check_order`.
        rows: numbers of the rows that are wanted, ``[B]``. Default: all.

    Returns:
        ``[B, A]``.
    """
    rows = torch.arange(len(data)) if rows is None else rows
    following: Tensor = data["action"][(rows + 1).clamp(max=len(data) - 1)]
    return following.masked_fill(data["next", "done"][rows], 0.0)


def is_followed(data: TensorDictBase, rows: Tensor | None = None) -> Tensor:
    """Whether the row after each is the one that came next in time, bool ``[B]``.

    Then the row ends no episode, and its next state is the state of the row after.

    Args:
        data: all transitions ``[N]``.
        rows: numbers of the rows that are asked about, ``[B]``. Default: all.
    """
    rows = torch.arange(len(data)) if rows is None else rows
    after = (rows + 1).clamp(max=len(data) - 1)
    there = data["next", "observation"][rows]
    state = data["observation"][after]
    slack = SAME_STATE * state.abs().clamp_min(1)
    apart = ((there - state).abs() > slack).any(-1)
    ends = data["next", "done"][rows].squeeze(-1) | (rows + 1 == len(data))
    followed: Tensor = ~(apart | ends)
    return followed


def check_order(data: TensorDictBase) -> None:
    """Raise unless every row that does not end an episode is followed by its next.

    Args:
        data: transitions ``[N]``; read in chunks.

    Raises:
        ValueError: naming the number of rows that are not, and the first.
    """
    wrong = 0
    first = len(data)
    for start in range(0, len(data), ROWS_AT_A_TIME):
        rows = torch.arange(start, min(start + ROWS_AT_A_TIME, len(data)))
        done = data["next", "done"][rows].squeeze(-1)
        jumps = rows[~(done | is_followed(data, rows))]
        if len(jumps):
            wrong += len(jumps)
            first = min(first, int(jumps[0]))
    if wrong:
        raise ValueError(
            f"{wrong:,} of the {len(data):,} rows, row {first} the first, end no "
            "episode and are not followed by the row that came next in time. Give the "
            "rows in order, and mark the last one of each episode as truncated."
        )
