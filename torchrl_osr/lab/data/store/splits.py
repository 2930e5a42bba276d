"""Which rows of a data set are used: held-out and consecutive rows, mixtures of sets.

Shapes: ``N`` transitions.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data.store.next_action import is_followed


def held_out_rows(rows: int, held_out: int | float, *, seed: int) -> Tensor:
    """Numbers of randomly chosen rows, in random order.

    Args:
        rows: number of rows ``N``.
        held_out: number of held-out rows (``int``), or their share (``float`` between
            0 and 1, rounded to whole rows).

    Keyword Args:
        seed: of the choice, which has a generator of its own.

    Raises:
        ValueError: none would be held out, or all.
    """
    count = round(held_out * rows) if isinstance(held_out, float) else held_out
    if not 0 < count < rows:
        raise ValueError(
            f"held_out={held_out!r} would hold out {count} of {rows} rows; "
            "expected at least one row on each side."
        )
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
    return order[:count].clone()  # not the rest of the memory with it


def split_held_out(
    data: TensorDict, held_out: int | float, *, seed: int
) -> tuple[TensorDict, TensorDict]:
    """Training and held-out rows, see :func:`held_out_rows`, in their original order.

    A memory-mapped set would be copied into memory: see ``left_out`` of
    :func:`~torchrl_osr.lab.data.make_replay_buffer`.
    """
    mask = torch.zeros(len(data), dtype=torch.bool)
    mask[held_out_rows(len(data), held_out, seed=seed)] = True
    mask = mask.to(data.device or "cpu")
    return data[~mask], data[mask]


def consecutive_rows(data: TensorDictBase, starts: Tensor, length: int) -> TensorDict:
    """Pieces of trajectories: each row is followed by the one that came after it.

    Args:
        data: transitions ``[N]`` in the order in which they were recorded.
        starts: numbers of the first rows. Those that are not followed by enough rows
            of the same trajectory are left out.
        length: rows of a piece, ``L``.

    Returns:
        Transitions ``[n, L]``; of ``starts``, ``n`` are left.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.data import consecutive_rows
        >>> state = torch.arange(4.0).unsqueeze(-1)
        >>> done = torch.tensor([[False], [True], [False], [False]])
        >>> data = TensorDict({"observation": state,
        ...     "next": {"observation": state + 1, "done": done}}, [4])
        >>> consecutive_rows(data, torch.tensor([0, 1, 2, 3]), 2)["observation"][..., 0]
        tensor([[0., 1.],
                [2., 3.]])
    """
    starts = starts[starts + length <= len(data)]
    rows = starts.unsqueeze(-1) + torch.arange(length, device=starts.device)
    followed = is_followed(data, rows[:, :-1].flatten())
    rows = rows[followed.view(len(starts), length - 1).all(1)]
    pieces: TensorDict = data[rows.flatten()].view(len(rows), length)
    return pieces


def mix_datasets(
    valuable: TensorDict, random: TensorDict, *, random_share: float, seed: int
) -> TensorDict:
    """Replace a share of the rows by rows of another data set; the number stays.

    Limited valuable data, section 5.3 of the paper. The rows of each set are drawn
    without replacement, and neither set is changed.

    Args:
        valuable: ``N`` transitions.
        random: at least as many as are needed of it.

    Keyword Args:
        random_share: of the ``N`` rows, rounded to whole ones.
        seed: of the choice, which has a generator of its own.

    Returns:
        ``N`` transitions: those kept of ``valuable``, then those of ``random``.

    Raises:
        ValueError: if the share is not between 0 and 1, or ``random`` is too small.
    """
    if not 0 <= random_share <= 1:
        raise ValueError(f"random_share must be in [0, 1], got {random_share}.")
    number = round(random_share * len(valuable))
    if number > len(random):
        raise ValueError(
            f"random_share={random_share} of {len(valuable)} rows is {number}, but the "
            f"random set has {len(random)}: collect more, or lower the share."
        )
    generator = torch.Generator().manual_seed(seed)
    kept = torch.randperm(len(valuable), generator=generator)[number:].sort().values
    taken = torch.randperm(len(random), generator=generator)[:number].sort().values
    mixed: TensorDict = torch.cat([valuable[kept], random[taken]])
    return mixed
