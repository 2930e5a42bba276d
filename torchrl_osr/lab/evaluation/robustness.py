"""Episodes with and without disturbances, in pairs: same policy, same start state.

``docs/robustness.md`` explains the measures. Shapes: ``E`` pairs of episodes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_osr.lab.data import ReferenceReturns
from torchrl_osr.lab.envs import NotPossible
from torchrl_osr.lab.evaluation.episodes import EpisodeEvaluator, UnitPolicy, Wrap
from torchrl_osr.lab.evaluation.recovery import (
    DataDistance,
    Trajectory,
    measure_recovery,
)

TRANSIENT = ("knock", "push", "start")
"""Kinds of disturbance that end, so that there is something to recover from."""

RECOVERY = ("survived_knock", "alive_after", "clean_alive_after", "recovery_steps")
"""Entries of each episode after a disturbance that ends."""


@dataclass(frozen=True)
class Disturbance:
    """A disturbance, with a name unique in its suite.

    ``wrap`` puts it around an environment. Kinds in :data:`TRANSIENT` end.
    """

    name: str
    kind: str
    wrap: Wrap


def evaluate_paired(
    policy: UnitPolicy,
    env_id: str,
    disturbances: Sequence[Disturbance],
    distance: DataDistance,
    *,
    num_episodes: int = 10,
    seed: int = 0,
    references: ReferenceReturns | None = None,
    advance: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Play clean episodes once, and the same episodes under each disturbance.

    Episodes of a pair have the same seed and start state, and the policy is called
    with batches of one size. Until the disturbance acts, those of a deterministic
    policy are equal, bit for bit. Warn if the environment ignores its seed. The policy
    is called on the CPU.

    Keyword Args:
        num_episodes, seed: see :class:`~torchrl_osr.lab.evaluation.EpisodeEvaluator`.
        references: to normalise returns by. Default: no scores.
        advance: called after the clean episodes and after each disturbance.

    Returns:
        JSON-compatible. ``"clean"``: lists ``"returns"``, ``"lengths"``, ``"seeds"``
        and, with references, ``"scores"``, one entry an episode. ``"levels"``: the same
        for each disturbance, with its ``"name"`` and ``"kind"``.
        ``"disturbed_at"`` is the step of the disturbance (``None``: the episode ended
        before). The entries of
        :func:`~torchrl_osr.lab.evaluation.recovery.measure_recovery` are ``None`` if
        the disturbance does not end.
    """

    def play(wrap: Wrap | None) -> tuple[dict[str, Any], list[Trajectory]]:
        evaluator = EpisodeEvaluator(
            env_id, num_episodes=num_episodes, seed=seed, wrap=wrap, fixed_batch=True
        )
        played = [Trajectory() for _ in range(num_episodes)]
        with closing(evaluator):
            if wrap is None:
                first = evaluator.environments[0]
                start, again = (first.reset(seed=seed)[0] for _ in range(2))
                if not np.array_equal(start, again):
                    warnings.warn(
                        f"{env_id} ignores its seed: two resets with seed {seed} give "
                        "different observations, and the pairs are not pairs.",
                        stacklevel=3,
                    )
            results = evaluator(policy, lambda at, *entry: played[at].record(*entry))
        advance()
        names = ("returns", "lengths", "seeds")
        raw = {name: getattr(results, name).tolist() for name in names}
        if references is not None:
            raw["scores"] = references.score(results.returns).tolist()
        return raw, played

    clean, undisturbed = play(None)
    levels = []
    for each in disturbances:
        results, played = play(each.wrap)
        blocks = [trajectory.disturbance() for trajectory in played]
        # A disturbance of the start state counts as step 0.
        moments = [block and max(block[0] - 1, 0) for block in blocks]
        recovery: dict[str, Any] = dict.fromkeys(RECOVERY)
        if each.kind in TRANSIENT:
            pairs = zip(played, undisturbed, strict=True)
            found = [measure_recovery(*pair, distance) for pair in pairs]
            recovery = {key: [row and row[key] for row in found] for key in RECOVERY}
        level = {"name": each.name, "kind": each.kind}
        levels.append(level | results | {"disturbed_at": moments} | recovery)
    return {"clean": clean, "levels": levels}


def impossible_disturbances(
    env_id: str, disturbances: Sequence[Disturbance]
) -> dict[str, str]:
    """Return the reasons why the environment does not allow a disturbance, by name."""
    reasons = {}
    for each in disturbances:
        try:
            EpisodeEvaluator(env_id, num_episodes=1, wrap=each.wrap).close()
        except NotPossible as error:
            reasons[each.name] = str(error)
    return reasons
