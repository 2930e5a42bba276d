"""Roll out named data sets from the behaviour policies of the package.

In the mazes, a planner gives the next of the four cells beside a cell, and a controller
pushes the point towards it. Both see only the observation: the behaviour has no memory.

One environment, one process and NumPy policies: on one core this is faster than
vectorised environments or torch policies.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import cache
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import flatdim
from numpy.typing import NDArray
from tensordict import TensorDict
from tqdm.auto import tqdm

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data.behavior import behavior_policy_path, load_behavior_policy
from torchrl_osr.lab.data.environment import MAZE_IDS, environment_id, make_environment
from torchrl_osr.lab.data.transitions import ACTION_LIMIT, as_transitions

BEHAVIORS: dict[str, tuple[str, ...]] = {
    "random": (),
    "medium": ("medium",),
    "medium-replay": tuple(f"replay_{number}" for number in range(1, 9)),
    "medium-expert": ("medium", "expert"),
    "expert": ("expert",),
}
"""Behaviour policies of each source, in equal shares; ``random`` needs none."""

ActionSampler = Callable[[NDArray[Any], np.random.Generator], NDArray[np.float32]]
"""Draws an action ``[A]`` for an observation ``[S]``."""

Cell = tuple[int, int]
"""Row and column."""

# Start and goal are two different free cells, as the environment itself draws them, or
# a pair of PLAY_CELLS. The environment moves both within their cells.
MAZE_SOURCES = ("diverse", "play")

# Row and column of start and goal, picked by hand: long ways, from and to all corners.
PLAY_CELLS: dict[str, list[tuple[Cell, Cell]]] = {
    "pointmaze-medium": [
        *(((1, 1), (6, 6)), ((6, 1), (1, 6)), ((2, 6), (6, 5))),
        *(((4, 6), (2, 1)), ((6, 6), (6, 1))),
    ],
    "pointmaze-large": [
        *(((1, 1), (7, 9)), ((7, 1), (1, 10)), ((1, 6), (7, 4))),
        *(((7, 10), (3, 1)), ((5, 4), (1, 9))),
    ],
}
"""Pairs of start and goal of source ``play``; the umaze has too few cells for it."""

# Force for a metre of distance, and for a metre a second of speed. They let the point
# reach its goal in almost every episode, with every fifth of its actions at a bound.
STIFFNESS, DAMPING = 2.0, 0.4

# Standard deviation of the noise on the force, whose bounds are -1 and 1.
ACTION_NOISE = 0.5

Collection = tuple[TensorDict, NDArray[np.float64], NDArray[np.int64]]


def behavior_of(env_name: str, source: str) -> dict[str, Any]:
    """Return the manifest's entries that determine the rows, with the seed."""
    known: Sequence[str] = [*BEHAVIORS]
    if env_name.startswith("antmaze"):
        known = ("minari",)  # no policy that walks ships with the package
    elif env_name in MAZE_IDS:
        known = MAZE_SOURCES if env_name in PLAY_CELLS else ("diverse",)
    if source not in known:
        raise ValueError(
            f"unknown data={source} of {env_name}; there are: {', '.join(known)}."
        )
    if env_name in MAZE_IDS:
        behavior = {
            "stiffness": STIFFNESS,
            "damping": DAMPING,
            "action_noise": ACTION_NOISE,
            "cells": PLAY_CELLS[env_name] if source == "play" else None,
        }
        return {"behavior": behavior}
    paths = {name: behavior_policy_path(env_name, name) for name in BEHAVIORS[source]}
    return {"behavior_sha256": {name: sha256_of(path) for name, path in paths.items()}}


def collect_source(
    env_name: str,
    source: str,
    num_transitions: int,
    *,
    seed: int = 0,
    progress: bool = True,
) -> Collection:
    """Roll out a named data set, see :func:`behavior_of`.

    The source enters the seed: a medium and a medium-expert set share no episode.
    """
    entropy = (seed, zlib.crc32(f"{env_name}-{source}".encode()))
    with closing(make_environment(environment_id(env_name))) as env:
        size = flatdim(env.action_space)

        def uniform(_: Any, rng: np.random.Generator) -> NDArray[np.float32]:
            return rng.uniform(-ACTION_LIMIT, ACTION_LIMIT, size).astype(np.float32)

        samplers: list[ActionSampler] = [uniform]
        if env_name in MAZE_IDS:
            samplers = [waypoint_sampler(env.get_wrapper_attr("maze"))]
            if source == "play":
                env = StartsAndGoals(env, PLAY_CELLS[env_name])
        elif names := BEHAVIORS[source]:
            samplers = [load_behavior_policy(env_name, name).sample for name in names]
        return collect_transitions(
            env, samplers, num_transitions, seed=entropy, progress=progress
        )


def collect_transitions(
    env: gymnasium.Env[Any, Any],
    samplers: Sequence[ActionSampler],
    num_transitions: int,
    *,
    seed: int | Sequence[int] = 0,
    progress: bool = True,
) -> Collection:
    """Roll out an exact number of transitions, in equal shares of several policies.

    Each policy plays episode after episode until its share is full; the last row of
    a share is then marked truncated. Rows are ordered by policy and time. The stored
    actions are the executed ones, clipped to ±0.999.

    Args:
        env: task as :func:`~torchrl_osr.lab.data.make_environment` returns it.
        samplers: one for each policy.
        num_transitions: ``N``, at least one for each policy.

    Keyword Args:
        seed: non-negative seed or seeds; global generators are not used.
        progress: show a progress bar when on a terminal.

    Returns:
        The transitions ``[N]``; returns and lengths ``[E]`` of complete episodes.
    """
    spaces = env.observation_space, env.action_space
    state, action = ((num_transitions, flatdim(space)) for space in spaces)
    columns: dict[str, NDArray[Any]] = {
        "observation": np.empty(state, np.float32),
        "action": np.empty(action, np.float32),
        "next_observation": np.empty(state, np.float32),
        "reward": np.empty(num_transitions, np.float32),
        "terminated": np.zeros(num_transitions, np.bool_),
        "truncated": np.zeros(num_transitions, np.bool_),
    }
    bounds = [num_transitions * i // len(samplers) for i in range(len(samplers) + 1)]
    seeds = np.random.SeedSequence(seed).spawn(len(samplers))
    episodes: list[tuple[float, int]] = []
    hidden = None if progress else True  # None: no bar where there is no terminal
    with tqdm(None, "collect", num_transitions, unit="step", disable=hidden) as bar:
        shares = zip(samplers, seeds, pairwise(bounds), strict=True)
        for sampler, child, (start, stop) in shares:
            rng = np.random.default_rng(child)
            while start < stop:
                rows = {name: column[start:stop] for name, column in columns.items()}
                length, episode_return = _play_episode(env, sampler, rng, rows)
                if episode_return is not None:
                    episodes.append((episode_return, length))
                start += length
                bar.update(length)
    returns, lengths = np.array(episodes, np.float64).reshape(-1, 2).T
    return as_transitions(columns), returns, lengths.astype(np.int64)


def _play_episode(
    env: gymnasium.Env[Any, Any],
    sampler: ActionSampler,
    rng: np.random.Generator,
    rows: dict[str, NDArray[Any]],
) -> tuple[int, float | None]:
    """Fill ``rows`` from their start; return the length, and the return if complete."""
    observation, _ = env.reset(seed=int(rng.integers(2**31)))
    episode_return = 0.0
    capacity = len(rows["reward"])
    for step in range(capacity):
        rows["observation"][step] = observation
        action = np.clip(sampler(observation, rng), -ACTION_LIMIT, ACTION_LIMIT)
        observation, reward, terminated, truncated, _ = env.step(action)
        rows["action"][step] = action
        rows["next_observation"][step] = observation
        rows["reward"][step] = reward
        episode_return += float(reward)
        if terminated or truncated:
            rows["terminated"][step] = terminated
            rows["truncated"][step] = truncated
            return step + 1, episode_return
    rows["truncated"][capacity - 1] = True
    return capacity, None


def waypoint_sampler(maze: Any) -> ActionSampler:
    r"""Return a noisy controller that leads the point to its goal.

    .. math::
        a = \mathrm{clip}(k (w - x) - d \dot x) + \sigma \epsilon

    with the middle :math:`w` of the next cell on a shortest way, or the goal itself
    once it is in this cell or the next.
    """
    rows = enumerate(maze.maze_map)
    free = {(i, j) for i, row in rows for j, cell in enumerate(row) if cell != 1}

    @cache
    def middle_of_next(start: Cell, goal: Cell) -> Any:
        path = shortest_path(free, start, goal)
        return maze.cell_rowcol_to_xy(np.array(path[1])) if len(path) > 2 else None

    def cell_of(position: NDArray[Any]) -> Any:
        return tuple(maze.cell_xy_to_rowcol(position).tolist())

    def sample(observation: NDArray[Any], rng: np.random.Generator) -> Any:
        position, goal, velocity = observation[:2], observation[2:4], observation[6:8]
        waypoint = middle_of_next(cell_of(position), cell_of(goal))
        waypoint = goal if waypoint is None else waypoint
        force = STIFFNESS * (waypoint - position) - DAMPING * velocity
        noise = ACTION_NOISE * rng.standard_normal(2)
        return (np.clip(force, -1, 1) + noise).astype(np.float32)

    return sample


def shortest_path(free: set[Cell], start: Cell, goal: Cell) -> list[Cell]:
    """Return a shortest path with both ends; up before down, left, right."""
    # From the goal: each cell that is reached then knows the next one on its path.
    next_cell: dict[Cell, Cell] = {goal: goal}
    waiting = deque([goal])
    while waiting and start not in next_cell:
        row, column = cell = waiting.popleft()
        for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            beside = row + down, column + right
            if beside in free and beside not in next_cell:
                next_cell[beside] = cell
                waiting.append(beside)
    path = [start]
    while path[-1] != goal:
        path.append(next_cell[path[-1]])
    return path


class StartsAndGoals(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A maze that draws start and goal of each episode from pairs of cells."""

    def __init__(self, env: gymnasium.Env[Any, Any], pairs: Sequence[Any]) -> None:
        super().__init__(env)
        self.pairs = pairs

    def reset(self, *, seed: int | None = None, **options: Any) -> Any:
        # Not the environment's own numbers: they move both within their cells.
        generator = np.random.default_rng(None if seed is None else [seed, 1])
        start, goal = self.pairs[int(generator.integers(len(self.pairs)))]
        cells = {"reset_cell": np.array(start), "goal_cell": np.array(goal)}
        return super().reset(seed=seed, options=cells)
