"""Episodes with and without a disturbance, in pairs: same policy, same start state.

Shapes: ``E`` episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from torchrl_osr.evaluation.data_distance import DataDistance
from torchrl_osr.evaluation.episodes import (
    EpisodeEvaluator,
    EpisodeResults,
    Policy,
    Wrap,
)
from torchrl_osr.evaluation.recovery import (
    Recorder,
    Recovery,
    disturbed_at,
    measure_recovery,
)

TRANSIENT = ("knock", "push", "start")
"""Kinds of disturbance that end, so that there is something to recover from."""


@dataclass(frozen=True)
class Level:
    """One disturbance at one strength.

    Attributes:
        name: unique in its suite.
        kind: what is disturbed; those of :data:`TRANSIENT` end.
        strength: in the unit of its kind.
        wrap: puts the disturbance around an environment. Default: nothing.
        policy: plays instead of the one that is evaluated, for attacks that sit
            between environment and policy. Default: that one.
    """

    name: str
    kind: str
    strength: float
    wrap: Wrap | None = None
    policy: Policy | None = None


class LevelResults(NamedTuple):
    """What came out of one level.

    Attributes:
        level: the disturbance.
        results: returns, lengths and seeds, ``[E]`` each.
        disturbed_at: step of the first disturbance of each episode, from 0; ``None``
            where the episode ended before it, or there is none.
        recovery: ``None`` for a disturbance that does not end.
    """

    level: Level
    results: EpisodeResults
    disturbed_at: list[int | None]
    recovery: Recovery | None


class PairedResults(NamedTuple):
    """Clean episodes, and those of each level with the same seeds.

    Attributes:
        clean: without a disturbance.
        levels: in the order of the suite.
    """

    clean: EpisodeResults
    levels: list[LevelResults]


def evaluate_paired(
    policy: Policy,
    env_id: str,
    levels: Sequence[Level],
    distance: DataDistance,
    *,
    num_episodes: int = 10,
    seed: int = 0,
    device: torch.device | str = "cpu",
    advance: Callable[[], object] = lambda: None,
) -> PairedResults:
    """Play clean episodes once, and the same episodes under each disturbance.

    Episodes of a pair have the same seed, hence the same start state, and the policy
    is called with batches of one size: until the disturbance acts they are equal, bit
    for bit. Every level has new environments, so that none inherits another's changes.

    Args:
        policy: what is evaluated.
        env_id: a Gymnasium id, ``"Hopper-v5"`` for instance.
        levels: the disturbances.
        distance: to the data that the policy was trained on.

    Keyword Args:
        num_episodes: ``E``, at least 2. Default 10.
        seed: the episodes are seeded ``seed, seed + 1, ...``. Default 0.
        device: where the policy is. Default CPU.
        advance: called after the clean episodes and after each level.

    Raises:
        ValueError: if ``num_episodes`` is below 2, two levels have one name, or a level
            is not possible for this environment.
    """
    if num_episodes < 2:
        raise ValueError(
            f"num_episodes must be at least 2, got {num_episodes}: one pair of "
            "episodes has no interval."
        )
    check_levels(env_id, levels)

    def play(policy: Policy, wrap: Wrap | None) -> tuple[EpisodeResults, Recorder]:
        evaluator = EpisodeEvaluator(
            env_id, num_episodes=num_episodes, seed=seed, device=device, wrap=wrap,
            fixed_batch=True,
        )  # fmt: skip
        recorder = Recorder(num_episodes)
        try:
            results = evaluator(policy, recorder)
        finally:
            evaluator.close()
        advance()
        return results, recorder

    clean, undisturbed = play(policy, None)
    played = []
    for level in levels:
        results, recorder = play(level.policy or policy, level.wrap)
        trajectories = recorder.trajectories
        played.append(
            LevelResults(
                level,
                results,
                # An attack is between environment and policy, in every step.
                [0] * num_episodes
                if level.policy
                else [disturbed_at(each) for each in trajectories],
                measure_recovery(trajectories, undisturbed.trajectories, distance)
                if level.kind in TRANSIENT
                else None,
            )
        )
    return PairedResults(clean, played)


def check_levels(env_id: str, levels: Sequence[Level]) -> None:
    """Raise unless every level has its own name and fits the environment.

    Raises:
        ValueError: naming the level and what is wrong with it.
    """
    names = [level.name for level in levels]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        raise ValueError(f"levels need one name each, got {names}.")
    for level in levels:
        try:
            EpisodeEvaluator(env_id, num_episodes=1, wrap=level.wrap).close()
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"level {level.name!r} is not possible for {env_id}: {error}"
            ) from error
