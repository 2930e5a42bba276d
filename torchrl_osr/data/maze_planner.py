"""Shortest ways through a grid of free cells and walls, found breadth first.

Shapes: ``I`` rows, ``J`` columns. A cell is ``(row, column)``; a step leads to one of
the four cells beside it.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]
"""Row and column."""


def shortest_path(free: NDArray[np.bool_], start: Cell, goal: Cell) -> list[Cell]:
    """Return a shortest way from ``start`` to ``goal``, both included.

    Of several it is always the same one: up goes before down, left and right.

    Args:
        free: which cells can be entered, ``[I, J]``.
        start, goal: free cells.

    Raises:
        ValueError: if one of them is a wall or outside, or there is no way.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.data.maze_planner import shortest_path
        >>> free = np.array([[1, 1, 1], [0, 0, 1], [1, 1, 1]], dtype=bool)
        >>> shortest_path(free, (0, 1), (2, 1))
        [(0, 1), (0, 2), (1, 2), (2, 2), (2, 1)]
    """
    for name, cell in (("start", start), ("goal", goal)):
        if not _is_free(free, cell):
            raise ValueError(f"{name} {cell} is a wall of the maze, or outside of it.")
    # From the goal, so that each cell that is reached knows the next one on its way.
    following: dict[Cell, Cell] = {goal: goal}
    waiting = deque([goal])
    while waiting and start not in following:
        cell = waiting.popleft()
        for beside in _beside(cell):
            if _is_free(free, beside) and beside not in following:
                following[beside] = cell
                waiting.append(beside)
    if start not in following:
        raise ValueError(f"no way leads from {start} to {goal}.")
    path = [start]
    while path[-1] != goal:
        path.append(following[path[-1]])
    return path


def _beside(cell: Cell) -> list[Cell]:
    row, column = cell
    return [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]


def _is_free(free: NDArray[np.bool_], cell: Cell) -> bool:
    # A negative index would count from the other side.
    inside = 0 <= cell[0] < free.shape[0] and 0 <= cell[1] < free.shape[1]
    return inside and bool(free[cell])
