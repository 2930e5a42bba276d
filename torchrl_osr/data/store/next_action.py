"""The data's next action: what the following row of the same episode did.

Shapes: ``N`` transitions, ``B`` rows of them, ``A`` action.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_osr.data.store.statistics import ROWS_AT_A_TIME

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


def check_order(data: TensorDictBase) -> None:
    """Raise unless every row that does not end an episode is followed by its next.

    Then the next state of the one is the state of the other.

    Args:
        data: transitions ``[N]``; read in chunks.

    Raises:
        ValueError: naming the number of rows that are not, and the first.
    """
    wrong = 0
    first = len(data)
    for start in range(0, len(data), ROWS_AT_A_TIME):
        # One row more, to which the chunk's last one leads.
        state = data["observation"][start : start + ROWS_AT_A_TIME + 1]
        rows = data["next"][start : start + ROWS_AT_A_TIME]
        apart = torch.ones(len(rows), dtype=torch.bool)  # the last row of all leads on
        before, after = rows["observation"][: len(state) - 1], state[1:]
        slack = SAME_STATE * after.abs().clamp_min(1)
        apart[: len(before)] = ((before - after).abs() > slack).any(-1)
        jumps = (apart & ~rows["done"].squeeze(-1)).nonzero()[:, 0]
        if len(jumps):
            wrong += len(jumps)
            first = min(first, start + int(jumps[0]))
    if wrong:
        raise ValueError(
            f"{wrong:,} of the {len(data):,} rows, row {first} the first, end no "
            "episode and are not followed by the row that came next in time. Give the "
            "rows in order, and mark the last one of each episode as truncated."
        )
