"""The named qualities of data, and the behaviour policies that each is rolled out from.

``random`` draws uniform actions; ``medium-replay`` stands for the replay buffer of a
training run by eight snapshots on the way to the medium policy; the mixtures are made
of equal shares. The mazes have qualities of their own,
see :mod:`torchrl_osr.lab.data.collect.mazes`.
"""

from __future__ import annotations

import zlib
from contextlib import closing
from typing import Any

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data.collect.behavior import (
    behavior_policy_path,
    load_behavior_policy,
)
from torchrl_osr.lab.data.collect.environment import (
    MAZE_IDS,
    environment_id,
    make_environment,
)
from torchrl_osr.lab.data.collect.mazes import maze_behavior, maze_players
from torchrl_osr.lab.data.collect.rollout import (
    Collection,
    collect_transitions,
    uniform_sampler,
)

QUALITIES: dict[str, tuple[str, ...]] = {
    "random": (),
    "medium": ("medium",),
    "medium-replay": tuple(f"replay_{number}" for number in range(1, 9)),
    "medium-expert": ("medium", "expert"),
    "expert": ("expert",),
}
"""Behaviour policies of each quality, in equal shares; ``random`` needs none."""


def quality_policies(quality: str) -> tuple[str, ...]:
    """Names of the behaviour policies that a quality is made of."""
    if quality not in QUALITIES:
        raise ValueError(
            f"unknown quality {quality!r}; there are: {', '.join(QUALITIES)}."
        )
    return QUALITIES[quality]


def behavior_of(env_name: str, quality: str) -> dict[str, Any]:
    """Entries of the manifest that decide, beside the seed, what the rows are."""
    if env_name in MAZE_IDS:
        return {"behavior": maze_behavior(env_name, quality)}
    checksums = {
        name: sha256_of(behavior_policy_path(env_name, name))
        for name in quality_policies(quality)
    }
    return {"behavior_sha256": checksums}


def collect_quality(
    env_name: str,
    quality: str,
    num_transitions: int,
    *,
    seed: int = 0,
    progress: bool = True,
) -> Collection:
    """Roll out one of the named data sets.

    Args:
        env_name: short environment name: ``"hopper"``, ``"walker2d"``,
            ``"halfcheetah"``, or ``"pointmaze-umaze"``, ``-medium`` or ``-large``.
        quality: a key of ``QUALITIES``; of a maze ``"diverse"`` or ``"play"``.
        num_transitions: exact number of transitions ``N``.

    Keyword Args:
        seed: non-negative seed. Default: 0. The quality enters too, so that a
            medium and a medium-expert set of one seed share no episode.
        progress: show a progress bar when on a terminal. Default: ``True``.

    Raises:
        ValueError: unknown environment or quality, or a number of transitions that does
            not give each policy one.
    """
    env_id = environment_id(env_name)
    behavior_of(env_name, quality)  # an unknown quality stops here
    entropy = (seed, zlib.crc32(f"{env_name}-{quality}".encode()))
    with closing(make_environment(env_id)) as env:
        if env_name in MAZE_IDS:
            env, samplers = maze_players(env, env_name, quality)
        else:
            samplers = [
                load_behavior_policy(env_name, name).sample
                for name in quality_policies(quality)
            ] or [uniform_sampler(env)]
        return collect_transitions(
            env, samplers, num_transitions, seed=entropy, progress=progress
        )
