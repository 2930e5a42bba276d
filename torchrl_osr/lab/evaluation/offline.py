"""Value of a policy on data alone, by fitted Q evaluation.

Shapes: ``N`` transitions, ``K`` critics, ``E`` episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.objectives import SoftUpdate

from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data import make_replay_buffer, observation_statistics
from torchrl_osr.lab.data.rows import check_order
from torchrl_osr.lab.data.store import is_memory_mapped
from torchrl_osr.lab.data.transitions import ROWS_AT_A_TIME
from torchrl_osr.lab.evaluation.episodes import Policy
from torchrl_osr.lab.evaluation.statistics import Array
from torchrl_osr.lab.losses import FQELoss
from torchrl_osr.modules import critic_ensemble
from torchrl_osr.trainers import OfflineTrainer


def fitted_values(
    data: TensorDict,
    policy: Policy,
    *,
    gamma: float = 0.99,
    steps: int = 4000,
    num_critics: int = 3,
    num_cells: Sequence[int] = (128, 128),
    batch_size: int = 128,
    lr: float = 1e-3,
    tau: float = 0.05,
    seed: int = 0,
    progress: bool = True,
) -> Array:
    """Return a policy's discounted return from the first state of each episode.

    Args:
        data: transitions ``[N]`` in order of time, as of ``load_dataset``.
        policy: maps observations ``[B, S]`` to actions within -1 and 1, or to numbers
            of discrete actions.

    Keyword Args:
        gamma: discount factor, below 1.
        steps, batch_size, lr, tau: of the training of the critics.
        num_critics, num_cells: number and sizes of critics. Each learns from episodes
            drawn with replacement.
        seed: of networks, batches and drawn episodes.
        progress: show a progress bar.

    Returns:
        Values ``[K, E]``, one for each critic and episode.

    Raises:
        ValueError: the rows are not in order of time, or the discount is 1.

    Examples:
        >>> from torchrl_osr.lab.data import load_dataset
        >>> from torchrl_osr.lab.evaluation import fitted_values
        >>> data, _ = load_dataset("hopper", "random", num_transitions=300)
        >>> options = {"steps": 10, "num_critics": 2, "progress": False}
        >>> len(fitted_values(data, lambda state: state[:, :3].tanh(), **options))
        2
    """
    if not 0 <= gamma < 1:
        raise ValueError(f"The discount is {gamma}; expected at least 0 and below 1.")
    check_order(data)
    ends = data["next", "done"].squeeze(-1)
    first = torch.cat([ends.new_ones(1), ends[:-1]])
    episode, starts = first.cumsum(0) - 1, data["observation"][first]
    number, size = len(starts), data["action"].shape[-1]

    def act(states: Tensor) -> Tensor:
        parts = torch.split(states, ROWS_AT_A_TIME)
        action = torch.cat([policy(rows) for rows in parts])
        return action if action.ndim > 1 else one_hot(action, size).float()

    next_action = act(data["next", "observation"])
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(number, (num_critics, number), generator=generator)
    weight = torch.stack([each.bincount(minlength=number) for each in drawn]).float()
    loc, scale = observation_statistics(data)
    reward = data["next", "reward"]
    # Values are then between -1 and 1.
    unit = max(reward.abs().max().item(), 1e-8) / (1 - gamma)

    def read(data: TensorDictBase, rows: Tensor | None = None) -> TensorDictBase:
        batch = data.copy() if rows is None else data[rows]
        rows = torch.arange(len(data)) if rows is None else rows
        batch["observation"] = (batch["observation"] - loc) / scale
        batch["next", "observation"] = (batch["next", "observation"] - loc) / scale
        batch["next", "reward"] = batch["next", "reward"] / unit
        batch["next", "action"] = next_action[rows]
        batch["bootstrap"] = weight[:, episode[rows]].T
        return batch

    on_disk: Any = {"read": read} if is_memory_mapped(data) else {}
    rows = data if on_disk else read(data)
    buffer = make_replay_buffer(rows, batch_size=batch_size, seed=0, **on_disk)
    least, most = (each.item() / unit / (1 - gamma) for each in reward.aminmax())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        critics = critic_ensemble(
            starts.shape[-1],
            size,
            num_qvalue_nets=num_critics,
            num_cells=num_cells,
            layer_norm=True,
        )
    bounds = min(0.0, least), max(0.0, most)
    loss = FQELoss(critics, value_bounds=bounds, deactivate_vmap=True)
    loss.make_value_estimator(gamma=gamma)
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr, fused=True)
    with TemporaryDirectory() as folder:
        OfflineTrainer(
            FastUpdate(loss, optimizer, SoftUpdate(loss, tau=tau)),
            buffer,
            steps,
            folder,
            seed=seed,
            checkpoint_interval=steps,
            description="fitted Q evaluation",
            progress=progress,
        ).train()
    states = TensorDict({"observation": (starts - loc) / scale}, [number])
    with torch.no_grad():
        value = loss.q(states, act(starts), loss.target_qvalue_network_params)
    found: Array = (unit * value).double().numpy()
    return found


def episode_values(data: TensorDict, gamma: float) -> Array:
    """Return the discounted return of each recorded episode, ``[E]``."""
    reward = data["next", "reward"].squeeze(-1).double().numpy()
    ends = np.flatnonzero(data["next", "done"].squeeze(-1).numpy())
    parts = np.split(reward, ends[:-1] + 1)
    return np.array([each @ gamma ** np.arange(len(each)) for each in parts])
