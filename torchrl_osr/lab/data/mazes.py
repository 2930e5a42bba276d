"""A point that finds its way through a maze: the behaviour of the maze data sets.

A planner gives the next of the four cells beside a cell, a controller pushes the point
towards it. Both know only the observation, so that the behaviour has no memory.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

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
# reach its goal in almost every episode at about 3 m/s, with every fifth number of its
# actions at a bound; stiffer ones leave hardly an action that is not.
STIFFNESS, DAMPING = 2.0, 0.4

# Standard deviation of the noise on the force, whose bounds are -1 and 1.
ACTION_NOISE = 0.5


def maze_behavior(env_name: str, source: str) -> dict[str, Any]:
    """Entries of the manifest that determine a maze set."""
    known = MAZE_SOURCES if env_name in PLAY_CELLS else ("diverse",)
    if env_name.startswith("antmaze"):
        known = ("minari",)  # no policy that walks ships with the package
    if source not in known:
        raise ValueError(
            f"unknown data={source} of {env_name}; there are: {', '.join(known)}."
        )
    return {
        "stiffness": STIFFNESS,
        "damping": DAMPING,
        "action_noise": ACTION_NOISE,
        "cells": PLAY_CELLS[env_name] if source == "play" else None,
    }


def waypoint_sampler(maze: Any) -> ActionSampler:
    r"""Noisy controller that leads the point to its goal.

    .. math::
        a = \mathrm{clip}(k (w - x) - d \dot x) + \sigma \epsilon

    with the middle :math:`w` of the next cell on a shortest way, or the goal itself
    once it is in this cell or the next.

    ``maze`` is gymnasium-robotics' ``Maze`` of the environment.
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
    """Free cells of a shortest way from ``start`` to ``goal``, both included.

    Of several it is always the same one: up goes before down, left and right.
    """
    # From the goal, so that each cell that is reached knows the next one on its way.
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
