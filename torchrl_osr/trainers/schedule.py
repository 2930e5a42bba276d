"""Learning rates over a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from torchrl_osr._checks import check_choice

SCHEDULES = ("constant", "cosine")


def learning_rates(
    optimizer: Optimizer, schedules: Sequence[str], total_steps: int
) -> LambdaLR:
    r"""Learning rates of an optimizer's groups, each on a schedule of its own.

    Args:
        optimizer: has as many groups of parameters as there are schedules.
        schedules: of each group: ``"constant"``, or ``"cosine"``, from the full rate to
            0: :math:`\tfrac12 (1 + \cos(\pi t / T))` of it at step t of T.
        total_steps: T.

    Returns:
        A scheduler, to be stepped after each step of the optimizer.

    Examples:
        >>> import torch
        >>> from torchrl_osr.trainers import learning_rates
        >>> parameter = torch.nn.Parameter(torch.zeros(()))
        >>> optimizer = torch.optim.Adam([parameter], lr=1e-3)
        >>> scheduler = learning_rates(optimizer, ["cosine"], total_steps=2)
        >>> optimizer.step(), scheduler.step()
        (None, None)
        >>> scheduler.get_last_lr()
        [0.0005]
    """
    for kind in schedules:
        check_choice("schedule", kind, SCHEDULES)
    cosine = partial(_cosine, total_steps=total_steps)
    return LambdaLR(
        optimizer, [cosine if kind == "cosine" else _constant for kind in schedules]
    )


def _constant(_: int) -> float:
    return 1.0


def _cosine(step: int, total_steps: int) -> float:
    return 0.5 * (1 + math.cos(math.pi * min(step / total_steps, 1.0)))
