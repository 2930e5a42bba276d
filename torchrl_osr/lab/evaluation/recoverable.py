"""Benchmark of recoverable states.

A policy starts from states that are sorted by whether a way back is known.
Shapes: ``M`` states, ``Q`` positions, ``V`` velocities.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from torchrl_osr._checks import check_choice
from torchrl_osr._files import read_arrays
from torchrl_osr.lab.data.environment import MAZE_IDS, known_ids
from torchrl_osr.lab.evaluation.episodes import EpisodeEvaluator, UnitPolicy

GROUPS = ("easy", "contested", "recoverable")
"""No reference policy failed; some did; all did, and a planner did not."""

SPEED_STEPS = 50  # HalfCheetah's speed is the mean over so many
AT_ONCE = 16  # states are played at once
STATES = Path(__file__).parent / "states"
HALVES = ("public", "held-out", "sealed")


@dataclass(frozen=True, eq=False)
class RecoverableStates:
    """States of one task, ``[M]`` each, in one of :data:`GROUPS`."""

    env_name: str
    qpos: NDArray[np.float64]  # [M, Q]
    qvel: NDArray[np.float64]  # [M, V]
    goal: NDArray[np.float64]  # in a maze, [M, 2]
    group: NDArray[Any]
    walk: NDArray[np.int32]  # number of the walk it comes from; those of one are alike
    kind: NDArray[Any]  # of disturbance
    strength: NDArray[np.float64]
    steps: int  # to play from each state
    least_speed: float  # that HalfCheetah must regain, m/s

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def disturbance(self) -> list[str]:
        """Kind and strength of each state's disturbance, such as ``"torque 10"``."""
        of_each = zip(self.kind, self.strength, strict=True)
        return [f"{kind} {strength:g}" for kind, strength in of_each]


def disturbances_of(names: Iterable[str]) -> list[str]:
    """Return the distinct disturbances, sorted by kind and strength."""
    parts = {name: name.rpartition(" ") for name in names}
    return sorted(parts, key=lambda name: (parts[name][0], float(parts[name][2])))


def load_recoverable_states(env_name: str, half: str = "public") -> RecoverableStates:
    """Load the states of one task, ``"walker2d"`` for instance.

    Choose methods by the ``"public"`` half. Evaluate a finished method once on the
    ``"held-out"`` half, or on the newer ``"sealed"`` states of Hopper and Walker2d.

    Examples:
        >>> states = load_recoverable_states("walker2d")
        >>> states.qpos.shape[1], sorted(set(states.group.tolist()))
        (9, ['contested', 'easy', 'recoverable'])
    """
    check_choice("half", half, HALVES)
    files = STATES.glob(f"*-{half}.npz")
    names = tuple(sorted(path.stem.removesuffix(f"-{half}") for path in files))
    check_choice("the task of recoverable states", env_name, names)
    arrays = read_arrays(STATES / f"{env_name}-{half}.npz")
    # The files also have the planner's solutions.
    kept: Any = {each.name: arrays[each.name] for each in fields(RecoverableStates)}
    kept |= {name: kept[name].item() for name in ("env_name", "steps", "least_speed")}
    return RecoverableStates(**kept)


def recovers(states: RecoverableStates, policy: UnitPolicy) -> NDArray[np.bool_]:
    """Return whether a policy recovers from each state, ``[M]``.

    Hopper and Walker2d: no fall within ``steps`` steps. HalfCheetah: a mean speed of
    at least ``least_speed`` over the last 50 of these steps. Maze: the goal is reached.
    """
    back = np.zeros(len(states), dtype=np.bool_)
    waiting = iter(range(len(states)))
    evaluator = EpisodeEvaluator(
        known_ids()[states.env_name],
        num_episodes=max(1, min(AT_ONCE, len(states))),
        fixed_batch=True,  # falls are chaotic: rounding decides some of them
        wrap=lambda env: TimeLimit(_Start(env, states, waiting), states.steps),
    )
    stood: NDArray[np.bool_]
    speeds: list[deque[float]]

    def watch(episode: int, _: Any, terminated: bool, info: dict[str, Any]) -> None:
        stood[episode] &= not terminated
        speeds[episode].append(float(info.get("x_velocity", 0.0)))

    for first in range(0, len(states), AT_ONCE):
        stood = np.ones(len(evaluator.environments), dtype=np.bool_)
        speeds = [deque(maxlen=SPEED_STEPS) for _ in stood]
        good = evaluator(policy, watch).successes
        if good is None:
            good = stood & (np.array([*map(np.mean, speeds)]) >= states.least_speed)
        back[first:][:AT_ONCE] = good[: len(states) - first]
    evaluator.close()
    return back


class _Start(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Begin each episode in the next of the states that wait, or in the first."""

    def __init__(
        self, env: Any, states: RecoverableStates, waiting: Iterator[int]
    ) -> None:
        super().__init__(env)
        self.states, self.waiting = states, waiting

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        _, info = super().reset(**options)
        number = next(self.waiting, 0)
        bare: Any = self.unwrapped
        state = self.states.qpos[number], self.states.qvel[number]
        if self.states.env_name not in MAZE_IDS:
            bare.set_state(*state)
            return bare._get_obs(), info
        bare.goal = self.states.goal[number].copy()
        bare.update_target_site_pos()
        bare.point_env.set_state(*state)
        observation = bare._get_obs(bare.point_env._get_obs()[0])
        return gymnasium.spaces.flatten(bare.observation_space, observation), info
