"""Rows of a data set: held out, mixed, and several steps together.

Shapes: ``N`` transitions, ``B`` rows of them, ``A`` action.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data.transitions import SAME_STATE

PIECE = 1000
"""Successive rows that a mixture takes together."""


def split_held_out(
    data: TensorDict, held_out: int | float, *, seed: int
) -> tuple[TensorDict, TensorDict]:
    """Copy training and held-out rows; ``held_out`` is a number, or a share (float)."""
    rows = len(data)
    count = round(held_out * rows) if isinstance(held_out, float) else held_out
    if not 0 < count < rows:
        raise ValueError(
            f"held_out={held_out!r} would hold out {count} of {rows} rows; "
            "expected at least one row on each side, as with data.held_out=0.2."
        )
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
    held, kept = torch.split(order, [count, rows - count])
    return data[kept.sort().values], data[held.sort().values]


def mix_datasets(
    valuable: TensorDict, random: TensorDict, *, random_share: float, seed: int
) -> TensorDict:
    """Replace a share of the rows by rows of another set, which come last.

    Rows are kept and taken in pieces of :data:`PIECE`, for returns of several steps.
    The row before a cut becomes truncated.
    """
    if not 0 <= random_share <= 1:
        raise ValueError(f"random_share={random_share}; expected a share from 0 to 1.")
    number = round(random_share * len(valuable))
    generator = torch.Generator().manual_seed(seed)
    chosen = []
    for data, count in (valuable, len(valuable) - number), (random, number):
        pieces = torch.split(torch.arange(len(data)), PIECE)
        order = torch.randperm(len(pieces), generator=generator).tolist()
        rows = torch.cat([pieces[piece] for piece in order])[:count]
        chosen.append(data[rows.sort().values])
    mixed: TensorDict = torch.cat(chosen)
    cut = ~is_followed(mixed) & ~mixed["next", "done"].squeeze(-1)
    for flag in ("done", "truncated"):
        mixed["next", flag][cut] = True
    return mixed


def is_followed(data: TensorDictBase) -> Tensor:
    """Return whether the next row in time follows each row, bool ``[N]``."""
    followed: Tensor = ~data["next", "done"].squeeze(-1)
    pair = data["next", "observation"][:-1], data["observation"][1:]
    followed[:-1] &= torch.isclose(*pair, SAME_STATE, SAME_STATE).all(-1)
    followed[-1] = False
    return followed


def next_action(data: TensorDictBase) -> Tensor:
    """Return the action ``[N, A]`` of the following row, 0 at an episode's end."""
    check_order(data)
    return data["action"].roll(-1, 0).masked_fill(data["next", "done"], 0.0)


def check_order(data: TensorDictBase) -> None:
    """Raise unless every row that does not end an episode is followed by its next."""
    followed = data["next", "done"].squeeze(-1) | is_followed(data)
    if wrong := (~followed).nonzero()[:, 0].tolist():
        raise ValueError(
            f"{len(wrong):,} of the {len(data):,} rows, row {wrong[0]} the first, end "
            "no episode and are not followed by the row that came next in time. Give "
            "the rows in order, and mark ends of episodes as truncated."
        )


def episode_of(data: TensorDictBase) -> Tensor:
    """Return the number of each row's episode, int ``[N]``; see :func:`check_order`."""
    check_order(data)
    done: Tensor = data["next", "done"].squeeze(-1)
    return done.cumsum(0) - done.long()


def multi_step(data: TensorDictBase, *, n_steps: int, gamma: float) -> TensorDict:
    r"""Return the entries of ``"next"`` after at most ``n_steps`` steps of the data.

    The reward is :math:`\sum_{k<m} \gamma^k r_k`. State, flags and action, if there is
    one, are those after the last of the m steps. The number m, ``"steps"`` ``[B, 1]``,
    is less than ``n_steps`` where an episode ends or the next row is not next in time.

    TorchRL 0.14.1's ``MultiStep`` keeps the flags of the first step: it bootstraps
    returns that have reached a terminal state.
    """
    single = data["next", "reward"]
    followed, last = is_followed(data), torch.arange(len(data))
    steps, reward = torch.ones_like(last), single.clone()
    for step in range(1, n_steps):
        goes_on = followed[last]
        if not goes_on.any():
            break
        last = last + goes_on
        reward += goes_on.unsqueeze(-1) * gamma**step * single[last]
        steps += goes_on
    return data["next"][last].set("reward", reward).set("steps", steps.unsqueeze(-1))


def take_multi_step(batch: TensorDictBase) -> TensorDictBase:
    """Set ``"next"`` to :func:`multi_step`, and ``"one_step"`` to the old ``"next"``.

    Some losses ask which action leads to the next state. ``"steps_to_next_obs"`` is
    TorchRL's name for the number of steps.
    """
    after = batch["multi_step"]
    batch = batch.exclude("multi_step").set("one_step", batch["next"])
    batch["steps_to_next_obs"] = after["steps"]
    return batch.set("next", after.exclude("steps"))
