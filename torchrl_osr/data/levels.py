"""The named levels of data, and the behaviour policies that each is rolled out from.

``random`` draws uniform actions; ``medium-replay`` stands for the replay buffer of a
training run by eight snapshots on the way to the medium policy; the mixtures are made
of equal shares.
"""

from __future__ import annotations

import zlib
from contextlib import closing

from torchrl_osr.data.behavior import load_behavior_policy
from torchrl_osr.data.collection import (
    ActionSampler,
    Collection,
    collect_transitions,
    uniform_sampler,
)
from torchrl_osr.data.environment import environment_id, make_environment

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


def collect_level(
    env_name: str,
    level: str,
    num_transitions: int,
    *,
    seed: int = 0,
    progress: bool = True,
) -> Collection:
    """Roll out one of the named data sets.

    Args:
        env_name: short environment name: ``"hopper"``, ``"walker2d"`` or
            ``"halfcheetah"``.
        level: a key of ``LEVELS``.
        num_transitions: exact number of transitions ``N``.

    Keyword Args:
        seed: non-negative seed. Default: 0. The level enters too, so that a
            medium and a medium-expert set of one seed share no episode.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Raises:
        ValueError: unknown environment or level, or a number of transitions that does
            not give each policy one.
    """
    env_id = environment_id(env_name)
    names = level_policies(level)
    entropy = (seed, zlib.crc32(f"{env_name}-{level}".encode()))
    samplers: list[ActionSampler] = [
        load_behavior_policy(env_name, name).sample for name in names
    ]
    with closing(make_environment(env_id)) as env:
        if not samplers:
            samplers = [uniform_sampler(env)]
        return collect_transitions(
            env, samplers, num_transitions, seed=entropy, progress=progress
        )
