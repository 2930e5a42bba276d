"""Roll out named data sets from the behaviour policies of the package.

One environment, one process and NumPy policies: on one core this is faster than
vectorised environments or torch policies.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from contextlib import closing
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
from torchrl_osr.lab.data.environment import MAZE_IDS, known_ids, make_environment
from torchrl_osr.lab.data.mazes import (
    ActionSampler,
    StartsAndGoals,
    ant_sampler,
    maze_behavior,
    maze_sources,
    point_sampler,
)
from torchrl_osr.lab.data.transitions import ACTION_LIMIT, as_transitions

BEHAVIORS: dict[str, tuple[str, ...]] = {
    "random": (),
    "medium": ("medium",),
    "medium-replay": tuple(f"replay_{number}" for number in range(1, 9)),
    "medium-expert": ("medium", "expert"),
    "expert": ("expert",),
}
"""Behaviour policies of each source, in equal shares; ``random`` needs none."""

Collection = tuple[TensorDict, NDArray[np.float64], NDArray[np.int64]]


def behavior_of(env_name: str, source: str) -> dict[str, Any]:
    """Return the manifest's entries that determine the rows, with the seed."""
    known = maze_sources(env_name) if env_name in MAZE_IDS else BEHAVIORS
    if source not in known:
        raise ValueError(
            f"unknown data={source} of {env_name}; there are: {', '.join(known)}."
        )
    if env_name in MAZE_IDS:
        return {"behavior": maze_behavior(env_name, source)}
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
    # Data have any start and goal, where D4RL's test has one of each.
    env_id = known_ids()[env_name].replace("_Test", "")
    with closing(make_environment(env_id)) as env:
        size = flatdim(env.action_space)

        def uniform(_: Any, rng: np.random.Generator) -> NDArray[np.float32]:
            return rng.uniform(-ACTION_LIMIT, ACTION_LIMIT, size).astype(np.float32)

        samplers: list[ActionSampler] = [uniform]
        if env_name in MAZE_IDS:
            lead = ant_sampler if env_name.startswith("ant") else point_sampler
            samplers = [lead(env.get_wrapper_attr("maze"))]
            if cells := maze_sources(env_name)[source]:
                env = StartsAndGoals(env, cells)
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
    actions are the executed ones, clipped to ±0.999. The task is one of
    :func:`~torchrl_osr.lab.data.make_environment`, with continuous actions.

    Also return returns and lengths ``[E]`` of complete episodes.
    """
    size = flatdim(env.observation_space)
    columns: dict[str, NDArray[Any]] = {
        "observation": np.empty((num_transitions, size), np.float32),
        "action": np.empty((num_transitions, flatdim(env.action_space)), np.float32),
        "next_observation": np.empty((num_transitions, size), np.float32),
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
            rng, ended = np.random.default_rng(child), True
            for row in range(start, stop):
                if ended:
                    observation, _ = env.reset(seed=int(rng.integers(2**31)))
                    episode_return, first = 0.0, row
                columns["observation"][row] = observation
                action = np.clip(sampler(observation, rng), -ACTION_LIMIT, ACTION_LIMIT)
                observation, reward, terminated, truncated, _ = env.step(action)
                columns["action"][row] = action
                columns["next_observation"][row] = observation
                columns["reward"][row] = reward
                columns["terminated"][row] = terminated
                columns["truncated"][row] = truncated
                episode_return += float(reward)
                if ended := terminated or truncated:
                    episodes.append((episode_return, row + 1 - first))
                bar.update()
            columns["truncated"][stop - 1] |= not columns["terminated"][stop - 1]
    returns, lengths = np.array(episodes, np.float64).reshape(-1, 2).T
    return as_transitions(columns), returns, lengths.astype(np.int64)
