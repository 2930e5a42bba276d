"""The named levels of data, and the behaviour policies that each is rolled out from.

``random`` draws uniform actions; ``medium-replay`` stands for the replay buffer of a
training run by eight snapshots on the way to the medium policy; the mixtures are made
of equal shares. The mazes have levels of their own, see :mod:`torchrl_osr.data.mazes`.
"""

from __future__ import annotations

import zlib
from contextlib import closing
from typing import TYPE_CHECKING, Any

from torchrl_osr.data.behavior import behavior_policy_path, load_behavior_policy
from torchrl_osr.data.collection import (
    ActionSampler,
    Collection,
    collect_transitions,
    uniform_sampler,
)
from torchrl_osr.data.environment import MAZE_IDS, environment_id, make_environment
from torchrl_osr.data.manifest import sha256_of
from torchrl_osr.data.mazes import maze_behavior, maze_players
from torchrl_osr.data.partial import PartialCollection

if TYPE_CHECKING:
    import gymnasium

LEVELS: dict[str, tuple[str, ...]] = {
    "random": (),
    "medium": ("medium",),
    "medium-replay": tuple(f"replay_{number}" for number in range(1, 9)),
    "medium-expert": ("medium", "expert"),
    "expert": ("expert",),
}
"""Behaviour policies of each level, in equal shares; ``random`` needs none."""


def level_policies(level: str) -> tuple[str, ...]:
    """Return the names of the behaviour policies that a level is made of.

    Raises:
        ValueError: unknown level.
    """
    if level not in LEVELS:
        raise ValueError(f"unknown level {level!r}; there are: {', '.join(LEVELS)}.")
    return LEVELS[level]


def behavior_of(env_name: str, level: str) -> dict[str, Any]:
    """Return what decides, beside the seed, what a level is, JSON-compatible.

    Raises:
        ValueError: unknown level.
    """
    if env_name in MAZE_IDS:
        return {"behavior": maze_behavior(env_name, level)}
    checksums = {
        name: sha256_of(behavior_policy_path(env_name, name))
        for name in level_policies(level)
    }
    return {"behavior_sha256": checksums}


def collect_level(
    env_name: str,
    level: str,
    num_transitions: int,
    *,
    seed: int = 0,
    progress: bool = True,
    partial: PartialCollection | None = None,
) -> Collection:
    """Roll out one of the named data sets.

    Args:
        env_name: short environment name: ``"hopper"``, ``"walker2d"``,
            ``"halfcheetah"``, or ``"pointmaze-umaze"``, ``-medium`` or ``-large``.
        level: a key of ``LEVELS``; of a maze ``"diverse"`` or ``"play"``.
        num_transitions: exact number of transitions ``N``.

    Keyword Args:
        seed: non-negative seed. Default: 0. The level enters too, so that a
            medium and a medium-expert set of one seed share no episode.
        progress: show a progress bar when on a terminal. Default: ``True``.
        partial: see :func:`~torchrl_osr.data.collect_transitions`.

    Raises:
        ValueError: unknown environment or level, or a number of transitions that does
            not give each policy one.
    """
    env_id = environment_id(env_name)
    behavior_of(env_name, level)  # an unknown level stops here
    entropy = (seed, zlib.crc32(f"{env_name}-{level}".encode()))
    with closing(make_environment(env_id)) as bare:
        env, samplers = _players(bare, env_name, level)
        return collect_transitions(
            env, samplers, num_transitions, seed=entropy, progress=progress,
            partial=partial,
        )  # fmt: skip


def _players(
    env: gymnasium.Env[Any, Any], env_name: str, level: str
) -> tuple[gymnasium.Env[Any, Any], list[ActionSampler]]:
    if env_name in MAZE_IDS:
        return maze_players(env, env_name, level)
    policies = [load_behavior_policy(env_name, name) for name in level_policies(level)]
    return env, [policy.sample for policy in policies] or [uniform_sampler(env)]
