"""Transitions of several steps, for TD targets that bootstrap later.

Shapes: ``N`` transitions, ``B`` rows of them.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_osr.lab.data.store.next_action import is_followed, next_action


def multi_step(
    data: TensorDictBase,
    rows: Tensor | None = None,
    *,
    n_steps: int,
    gamma: float,
    reward_scale: float = 1.0,
    reward_shift: float = 0.0,
    with_next_action: bool = False,
) -> TensorDict:
    r"""What each row leads to in at most ``n_steps`` steps of the data.

    The reward is :math:`\sum_{k<m} \gamma^k (a\,r_k + b)`; state and flags are what the
    last of the m steps led to. m is less than ``n_steps`` where an episode ends, or
    where the row after is not the one that came next in time.

    Not TorchRL 0.14.1's ``MultiStep``: it leaves the flags of the first step, so that
    returns that have reached a terminal state are bootstrapped from it.

    Args:
        data: all transitions ``[N]``.
        rows: numbers of the rows that are wanted, ``[B]``. Default: all.

    Keyword Args:
        n_steps: the largest m.
        gamma: discount factor.
        reward_scale: a.
        reward_shift: b.
        with_next_action: whether there is an ``"action"``, of the data at the state
            that the steps lead to, see :func:`next_action`.

    Returns:
        The entries of ``"next"``, and ``"steps"``, m, ``[B, 1]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_osr.lab.data.store.multi_step import multi_step
        >>> state, no = torch.arange(4.0).unsqueeze(-1), torch.zeros(3, 1).bool()
        >>> data = TensorDict({
        ...     "observation": state[:-1],
        ...     "next": {"observation": state[1:], "reward": torch.ones(3, 1),
        ...              "done": no, "terminated": no}}, [3])
        >>> multi_step(data, n_steps=2, gamma=0.5)["reward"].flatten()
        tensor([1.5000, 1.5000, 1.0000])
    """

    def reward_of(rows: Tensor) -> Tensor:
        reward: Tensor = data["next", "reward"][rows]
        return reward_scale * reward + reward_shift

    last = torch.arange(len(data)) if rows is None else rows
    whole = is_followed(data) if rows is None else None
    steps, reward = torch.ones_like(last), reward_of(last)
    for step in range(1, n_steps):
        goes_on = is_followed(data, last) if whole is None else whole[last]
        last = last + goes_on
        reward += goes_on.unsqueeze(-1) * gamma**step * reward_of(last)
        steps += goes_on
    found: TensorDict = data["next"].exclude("action")[last].set("reward", reward)
    if with_next_action:
        found["action"] = next_action(data, last)
    return found.set("steps", steps.unsqueeze(-1))


def take_multi_step(batch: TensorDictBase) -> TensorDictBase:
    """A batch whose ``"next"`` is :func:`multi_step`, which was in ``"multi_step"``.

    The transition of one step is then in ``"one_step"``, for the losses that ask which
    action leads to the next state; ``"steps_to_next_obs"`` is TorchRL's name for m.
    """
    after = batch["multi_step"]
    batch = batch.exclude("multi_step").set("one_step", batch["next"])
    batch["steps_to_next_obs"] = after["steps"]
    return batch.set("next", after.exclude("steps"))
