"""Behaviour in the mazes: a planner, and what it leads, a point or an ant.

The planner gives the next of the four cells beside a cell. A controller pushes the
point towards it; a policy that runs along x is turned to run there. All see only the
observation: the behaviour has no memory.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from torchrl_osr._files import sha256_of
from torchrl_osr.lab.data.behavior import (
    BEHAVIOR_POLICIES_DIR,
    behavior_policy_path,
    load_behavior_policy,
)
from torchrl_osr.lab.data.environment import TEST_CELLS, Cell

ActionSampler = Callable[[NDArray[Any], np.random.Generator], NDArray[np.float32]]
"""Draws an action ``[A]`` for an observation ``[S]``."""

# Row and column of start and goal, picked by hand: long ways, from and to all corners.
PLAY_CELLS: dict[str, list[tuple[Cell, Cell]]] = {
    "medium": [
        *(((1, 1), (6, 6)), ((6, 1), (1, 6)), ((2, 6), (6, 5))),
        *(((4, 6), (2, 1)), ((6, 6), (6, 1))),
    ],
    "large": [
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

# The policy that runs along x: its name, and the folder of its card.
HEADING = "ant", "heading", BEHAVIOR_POLICIES_DIR / "mazes"


def maze_sources(env_name: str) -> dict[str, list[tuple[Cell, Cell]] | None]:
    """Return pairs of start and goal by source; ``None``: any two free cells.

    Both are moved within their cells.
    """
    if env_name == "antmaze-umaze":
        return {"diverse": None, "umaze": [TEST_CELLS["umaze"]]}
    play = PLAY_CELLS.get(env_name.split("-")[1])
    return {"diverse": None} | ({"play": play} if play else {})


def maze_behavior(env_name: str, source: str) -> dict[str, Any]:
    """Return the manifest's entries that determine the rows."""
    cells = {"cells": maze_sources(env_name)[source]}
    if env_name.startswith("ant"):
        return {"heading_sha256": sha256_of(behavior_policy_path(*HEADING))} | cells
    force = {"stiffness": STIFFNESS, "damping": DAMPING, "action_noise": ACTION_NOISE}
    return force | cells


def planner(maze: Any) -> Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]:
    """Return a function of position and goal ``[2]`` that gives the next waypoint.

    It is the middle of the next cell on a shortest way, or the goal itself once it is
    in this cell or the next.
    """
    rows = enumerate(maze.maze_map)
    free = {(i, j) for i, row in rows for j, cell in enumerate(row) if cell != 1}

    @cache
    def middle_of_next(start: Cell, goal: Cell) -> Any:
        path = shortest_path(free, start, goal)
        return maze.cell_rowcol_to_xy(np.array(path[1])) if len(path) > 2 else None

    def waypoint(position: NDArray[Any], goal: NDArray[Any]) -> NDArray[Any]:
        cells = (maze.cell_xy_to_rowcol(each).tolist() for each in (position, goal))
        middle = middle_of_next(*map(tuple, cells))
        return goal if middle is None else np.asarray(middle)

    return waypoint


def point_sampler(maze: Any) -> ActionSampler:
    r"""Return a noisy controller that leads the point to its goal.

    .. math::
        a = \mathrm{clip}(k (w - x) - d \dot x) + \sigma \epsilon

    with the waypoint :math:`w` of :func:`planner`.
    """
    waypoint = planner(maze)

    def sample(observation: NDArray[Any], rng: np.random.Generator) -> Any:
        position, goal, velocity = observation[:2], observation[2:4], observation[6:8]
        force = STIFFNESS * (waypoint(position, goal) - position) - DAMPING * velocity
        noise = ACTION_NOISE * rng.standard_normal(2)
        return (np.clip(force, -1, 1) + noise).astype(np.float32)

    return sample


def ant_sampler(maze: Any) -> ActionSampler:
    """Return a policy that runs to the waypoints of :func:`planner`.

    The policy was trained to run along x. It sees the ant in a frame whose x axis
    points at the waypoint. Its actions are drawn, which is their noise.
    """
    waypoint = planner(maze)
    policy = load_behavior_policy(*HEADING[:2], folder=HEADING[2])

    def sample(observation: NDArray[Any], rng: np.random.Generator) -> Any:
        position, goal, ant = observation[:2], observation[2:4], observation[4:]
        across, along = (waypoint(position, goal) - position)[::-1]
        return policy.sample(turned(ant, -np.arctan2(across, along)), rng)

    return sample


def turned(ant: NDArray[Any], angle: float) -> NDArray[Any]:
    """Return Ant-v4's observation ``[27]`` of the ant turned about z, in radians.

    Of the two quaternions of an orientation it has the one with a positive real part,
    as the policy had in its training.
    """
    ant, half = ant.copy(), np.exp(0.5j * angle)
    w, x, y, z = ant[1:5]
    wz, xy = half * complex(w, z), half * complex(x, y)
    ant[1:5] = np.array([wz.real, xy.real, xy.imag, wz.imag]) * np.copysign(1, wz.real)
    speed = half**2 * complex(*ant[13:15])  # the angular one is in the ant's own frame
    ant[13:15] = speed.real, speed.imag
    return ant


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
