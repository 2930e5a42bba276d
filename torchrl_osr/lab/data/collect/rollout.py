"""Roll-outs of given policies, to an exact number of transitions.

Gymnasium and a NumPy policy, one environment, one process: on one core that was faster
than vectorised environments and than a torch policy.

Shapes: ``N`` transitions, ``E`` complete episodes, ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_osr._extras import needed_by
from torchrl_osr.lab.data.store.validation import ACTION_LIMIT, as_transitions

with needed_by("collecting data needs", "train"):
    import gymnasium
    from tqdm.auto import tqdm

ActionSampler = Callable[[NDArray[Any], np.random.Generator], NDArray[np.float32]]
"""Draws an action ``[A]`` for an observation ``[S]``."""


class Collection(NamedTuple):
    """Transitions, and the statistics of the episodes that were played to their end.

    Attributes:
        data: flat tensordict ``[N]``.
        episode_returns: undiscounted returns ``[E]``, float64.
        episode_lengths: steps ``[E]``.
    """

    data: TensorDict
    episode_returns: NDArray[np.float64]
    episode_lengths: NDArray[np.int64]


def uniform_sampler(env: gymnasium.Env[Any, Any]) -> ActionSampler:
    """Sampler of uniform actions in ``[-ACTION_LIMIT, ACTION_LIMIT]``."""
    action_size = gymnasium.spaces.flatdim(env.action_space)

    def sample(_: NDArray[Any], rng: np.random.Generator) -> NDArray[np.float32]:
        draws = rng.uniform(-ACTION_LIMIT, ACTION_LIMIT, action_size)
        return draws.astype(np.float32)

    return sample


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
    a share that is cut within an episode is marked truncated. The stored actions are
    the executed ones, clipped to ``ACTION_LIMIT``.

    Args:
        env: task as :func:`~torchrl_osr.lab.data.make_environment` returns it.
        samplers: draw actions ``[A]`` in -1 to 1 for an observation ``[S]``, given a
            NumPy generator; one for each policy.
        num_transitions: ``N``. If it does not divide by the number of policies, shares
            differ by one.

    Keyword Args:
        seed: non-negative seed or seeds; global generators are not used. Default: 0.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Returns:
        The transitions, ordered by policy and time, and the episode statistics.

    Raises:
        ValueError: fewer transitions than policies.
    """
    if not 0 < len(samplers) <= num_transitions:
        raise ValueError(
            f"num_transitions={num_transitions} for {len(samplers)} policies; "
            "expected at least one transition each."
        )
    state = num_transitions, gymnasium.spaces.flatdim(env.observation_space)
    action = num_transitions, gymnasium.spaces.flatdim(env.action_space)
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
    returns: list[float] = []
    lengths: list[int] = []
    # disable=None: no bar where the output is not a terminal.
    with tqdm(
        total=num_transitions,
        desc="collect",
        unit="step",
        disable=None if progress else True,
    ) as bar:
        for sampler, child, (start, stop) in zip(
            samplers, seeds, pairwise(bounds), strict=True
        ):
            rng = np.random.default_rng(child)
            while start < stop:
                rows = {name: column[start:stop] for name, column in columns.items()}
                length, episode_return = _play_episode(env, sampler, rng, rows)
                if episode_return is not None:
                    returns.append(episode_return)
                    lengths.append(length)
                start += length
                bar.update(length)
    return Collection(
        as_transitions(columns),
        np.asarray(returns, dtype=np.float64),
        np.asarray(lengths, dtype=np.int64),
    )


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
        action = np.clip(sampler(observation, rng), -ACTION_LIMIT, ACTION_LIMIT)
        next_observation, reward, terminated, truncated, _ = env.step(action)
        rows["observation"][step] = observation
        rows["action"][step] = action
        rows["next_observation"][step] = next_observation
        rows["reward"][step] = reward
        episode_return += float(reward)
        if terminated or truncated:
            rows["terminated"][step] = terminated
            rows["truncated"][step] = truncated
            return step + 1, episode_return
        observation = next_observation
    rows["truncated"][capacity - 1] = True
    return capacity, None
