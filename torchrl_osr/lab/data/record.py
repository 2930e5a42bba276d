"""Record episodes of any policy in any environment as a log."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from torchrl_osr._files import check_writable, whole_file

Act = Callable[[NDArray[Any]], ArrayLike]
"""Action in the environment's own units, ``[A]`` or a number, for a state ``[S]``."""


def record_episodes(
    env: gymnasium.Env[Any, Any],
    act: Act | None,
    num_episodes: int,
    *,
    noise: float = 0.0,
    seed: int = 0,
    progress: bool = True,
) -> dict[str, NDArray[Any]]:
    """Play whole episodes, seeded ``seed, seed + 1, ...``, and keep every step.

    Without ``act`` actions are drawn uniformly. ``noise`` is the standard deviation of
    Gaussian noise on actions, in half-widths of their bounds, which they are clipped
    to; of discrete actions the share that is drawn uniformly instead.
    """
    most = 1.0 if isinstance(env.action_space, spaces.Discrete) else math.inf
    if num_episodes < 1 or not 0 <= noise <= most:
        raise ValueError(
            f"episodes={num_episodes} noise={noise}: give at least 1 episode and noise "
            f"from 0 to {most}."
        )
    if act is None and noise:
        raise ValueError(f"noise={noise} has no effect with policy=random.")
    rng = np.random.default_rng([seed, 1])  # not the environment's own numbers
    env.action_space.seed(int(rng.integers(2**31)))
    steps: list[dict[str, Any]] = []

    def chosen(observation: NDArray[Any]) -> Any:
        space: Any = env.action_space
        if act is None:
            return space.sample()
        action = np.asarray(act(observation))
        if isinstance(space, spaces.Discrete):
            if rng.random() < noise:
                return space.sample()
            action = action[()] if action.ndim == 0 else action
        else:
            if action.shape == space.shape and noise:
                half = (space.high - space.low) / 2
                noisy = action + noise * half * rng.standard_normal(space.shape)
                action = np.clip(noisy, space.low, space.high)
            action = action.astype(space.dtype)
        if not space.contains(action):
            raise ValueError(
                f"the policy's action {np.asarray(action).tolist()} is not in {space}."
            )
        return action

    hidden = None if progress else True  # None: no bar off a terminal
    for episode in tqdm(range(num_episodes), "collect", unit="episode", disable=hidden):
        # Copies: the environment and the policy may write into their arrays.
        observation, ended = np.array(env.reset(seed=seed + episode)[0]), False
        while not ended:
            action = chosen(observation.copy())
            state, reward, terminated, truncated, _ = env.step(action)
            step = {
                "observation": observation,
                "action": np.array(action),
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
                "next_observation": np.array(state),
                "episode": episode,
            }
            steps.append(step)
            for name in ("observation", "next_observation", "reward"):
                shape = () if name == "reward" else env.observation_space.shape
                if np.shape(step[name]) != shape or not np.isfinite(step[name]).all():
                    raise ValueError(
                        f"step {len(steps)} of {env} has {name} {step[name]}; expected "
                        f"finite numbers of shape {shape}."
                    )
            observation, ended = step["next_observation"], terminated or truncated
    columns = {name: np.array([step[name] for step in steps]) for name in steps[0]}
    floats = [name for name, each in columns.items() if each.dtype.kind == "f"]
    return columns | {name: columns[name].astype(np.float32) for name in floats}


def check_log_path(path: Path) -> None:
    """Raise unless a log can be written there; make missing folders."""
    if path.suffix != ".npz":
        raise ValueError(f"path={path} must end in .npz.")
    if path.exists():
        raise FileExistsError(f"path={path} exists: choose another.")
    path.parent.mkdir(parents=True, exist_ok=True)
    check_writable(path.parent)


def write_log(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns to a file, whole or not at all; missing folders are made."""
    check_log_path(path)
    with whole_file(path) as file:
        np.savez(file, **columns)
