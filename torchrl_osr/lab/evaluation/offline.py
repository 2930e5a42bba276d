"""Value of a policy on data alone, by fitted Q evaluation.

Shapes: ``N`` transitions, ``K`` critics, ``E`` episodes.
"""

from __future__ import annotations

import gc
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.objectives import SoftUpdate

from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data import make_replay_buffer, observation_statistics
from torchrl_osr.lab.data.rows import episode_of
from torchrl_osr.lab.evaluation.episodes import UnitPolicy
from torchrl_osr.lab.evaluation.statistics import Array
from torchrl_osr.lab.losses import FQELoss
from torchrl_osr.modules import critic_ensemble
from torchrl_osr.trainers import OfflineTrainer

TAU = 0.05
"""Step size of the critics' targets."""


def fitted_values(
    data: TensorDict,
    policy: UnitPolicy,
    *,
    gamma: float = 0.99,
    steps: int | None = None,
    num_critics: int = 3,
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
        steps: of the critics' training. Default: until the targets have come 98 % of
            their way.
        num_critics: each learns from episodes drawn with replacement.
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
    check_discount(gamma)
    gc.collect()  # an earlier trainer is a reference cycle, and holds its rows
    episode = episode_of(data)
    starts = first_states(data, episode)
    number, size = len(starts), data["action"].shape[-1]
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(number, (num_critics, number), generator=generator)
    weight = torch.stack([each.bincount(minlength=number) for each in drawn]).float()
    loc, scale = observation_statistics(data)
    reward = data["next", "reward"]
    # Values are then between -1 and 1.
    unit = max(reward.abs().max().item(), 1e-8) / (1 - gamma)

    rows = data.copy()
    for key in ("observation", ("next", "observation")):
        rows[key] = (data[key] - loc) / scale
    rows["next", "reward"] = reward / unit
    rows["next", "action"] = act(policy, data["next", "observation"], size)
    rows["bootstrap"] = weight[:, episode].T
    least, most = (each.item() / unit / (1 - gamma) for each in reward.aminmax())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        critics = critic_ensemble(
            starts.shape[-1],
            size,
            num_qvalue_nets=num_critics,
            num_cells=(128, 128),
            layer_norm=True,
        )
    bounds = min(0.0, least), max(0.0, most)
    loss = FQELoss(critics, value_bounds=bounds, deactivate_vmap=True)
    loss.make_value_estimator(gamma=gamma)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, fused=True)
    update = FastUpdate(loss, optimizer, SoftUpdate(loss, tau=TAU))
    steps = steps or max(8000, round(4 / TAU / (1 - gamma)))
    fit(update, rows, "fitted Q evaluation", steps, seed=seed, progress=progress)
    states = TensorDict({"observation": (starts - loc) / scale}, [number])
    params = loss.target_qvalue_network_params
    with torch.no_grad():
        value = loss.q(states, act(policy, starts, size), params)
    return (unit * value).double().numpy()


def check_discount(gamma: float) -> None:
    """Raise unless the discounted return of an endless episode is finite."""
    if not 0 <= gamma < 1:
        raise ValueError(f"The discount is {gamma}; expected at least 0 and below 1.")


def first_states(data: TensorDict, episode: Tensor) -> Tensor:
    """Return the first state of each of the rows' episodes, ``[E, S]``."""
    first = episode.diff(prepend=episode.new_tensor([-1])) > 0
    return data["observation"][first]


def act(policy: UnitPolicy, states: Tensor, size: int) -> Tensor:
    """Return a policy's actions ``[B, size]`` at states ``[B, S]``."""
    action = torch.cat([policy(rows) for rows in torch.split(states, 2**20)])
    return action if action.ndim > 1 else one_hot(action, size).float()


def fit(
    update: FastUpdate, rows: TensorDict, name: str, steps: int, **options: Any
) -> None:
    """Train on rows ``[N]``, without checkpoints that stay; options of the trainer."""
    buffer = make_replay_buffer(rows, batch_size=128, seed=0)
    with TemporaryDirectory() as folder:
        fixed: Any = {"checkpoint_interval": steps, "description": name}
        OfflineTrainer(update, buffer, steps, folder, **fixed, **options).train()


def episode_values(data: TensorDict, gamma: float) -> Array:
    """Return the discounted return of each recorded episode, ``[E]``."""
    reward = data["next", "reward"].squeeze(-1).double().numpy()
    ends = np.flatnonzero(data["next", "done"].squeeze(-1).numpy())
    parts = np.split(reward, ends[:-1] + 1)
    return np.array([each @ gamma ** np.arange(len(each)) for each in parts])
