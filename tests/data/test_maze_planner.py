"""Ways through mazes made by hand, and their lengths by powers of a matrix."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from torchrl_osr.data.maze_planner import shortest_path


def maze(*rows: str):
    return np.array([[cell == "." for cell in row] for row in rows])


def test_the_shorter_of_two_ways_is_taken():
    free = maze(".....", ".###.", ".###.", ".....")
    left = [(0, 1), (0, 0), (1, 0), (2, 0), (3, 0)]
    assert shortest_path(free, (0, 1), (3, 0)) == left
    assert shortest_path(free, (0, 4), (3, 4)) == [(0, 4), (1, 4), (2, 4), (3, 4)]


def test_dead_ends_are_left_out():
    free = maze("..#.", "#.#.", "#...", "....")
    assert shortest_path(free, (0, 0), (0, 3)) == [
        *[(0, 0), (0, 1), (1, 1), (2, 1)],
        *[(2, 2), (2, 3), (1, 3), (0, 3)],
    ]


def test_the_goal_may_be_the_start():
    assert shortest_path(maze("."), (0, 0), (0, 0)) == [(0, 0)]


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        ((0, 1), (0, 0), r"start \(0, 1\) is a wall"),
        ((0, 0), (-1, 0), r"goal \(-1, 0\) is a wall of the maze, or outside"),
        ((0, 0), (0, 3), "goal .* outside"),
        ((0, 0), (0, 2), r"no way leads from \(0, 0\) to \(0, 2\)"),
    ],
)
def test_what_cannot_be_is_named(start, goal, message):
    with pytest.raises(ValueError, match=message):
        shortest_path(maze(".#."), start, goal)


@given(
    arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=5)),
    st.randoms(use_true_random=False),
)
def test_ways_are_valid_and_as_short_as_a_matrix_says(free, random):
    cells = [tuple(map(int, cell)) for cell in np.argwhere(free)]
    if not cells:
        return
    beside = np.array(
        [[abs(a - c) + abs(b - d) == 1 for c, d in cells] for a, b in cells]
    )
    start, goal = (random.randrange(len(cells)) for _ in range(2))
    # Cells that can be reached within 0, 1, 2, ... steps.
    reached, steps = np.arange(len(cells)) == start, 0
    while not reached[goal] and steps <= len(cells):
        reached, steps = reached | (beside @ reached), steps + 1
    if not reached[goal]:
        with pytest.raises(ValueError, match="no way"):
            shortest_path(free, cells[start], cells[goal])
        return
    path = shortest_path(free, cells[start], cells[goal])
    assert (path[0], path[-1]) == (cells[start], cells[goal])
    assert len(path) == steps + 1
    assert all(free[cell] for cell in path)
    moves = np.abs(np.diff(path, axis=0)).sum(axis=-1)
    assert (moves == 1).all()
