"""The maze data sets: their behaviour, their starts and goals, and their manifests."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from torchrl_osr.lab.data import check_dataset, load_dataset, make_environment
from torchrl_osr.lab.data.environment import MAZE_IDS
from torchrl_osr.lab.data.mazes import PLAY_CELLS, shortest_path, waypoint_sampler
from torchrl_osr.lab.data.rollout import collect_source

SETS = [
    ("pointmaze-umaze", "diverse"),
    ("pointmaze-medium", "play"),
    ("pointmaze-medium", "diverse"),
    ("pointmaze-large", "play"),
    ("pointmaze-large", "diverse"),
]


def cells_of(env_id, positions):
    with closing(make_environment(env_id)) as env:
        maze = env.unwrapped.maze
        return [tuple(maze.cell_xy_to_rowcol(each).tolist()) for each in positions]


def starts_of(data):
    first = np.r_[True, data["next", "done"].flatten()[:-1]]
    return data["observation"].numpy()[first]


@pytest.mark.parametrize(("env_name", "source"), SETS)
def test_nearly_every_episode_reaches_its_goal(env_name, source):
    data, returns, lengths = collect_source(env_name, source, 6000, progress=False)
    check_dataset(data)
    assert data.shape == (6000,)
    assert len(returns) >= 15
    assert returns.mean() > 0.95
    assert set(returns.tolist()) <= {0.0, 1.0}
    within = ~data["next", "done"].flatten()[:-1]
    following, observation = data["next", "observation"][:-1], data["observation"][1:]
    assert (following[within] == observation[within]).all()
    reward, terminated = data["next", "reward"], data["next", "terminated"]
    assert ((reward == 1) == terminated).all()
    assert ((reward == 0) | (reward == 1)).all()
    # The goal stays, and the noise leaves most of the actions inside of their bounds.
    assert (data["observation"][:, 2:4] == data["next", "observation"][:, 2:4]).all()
    assert (data["action"].abs() > 0.998).float().mean() < 0.3
    assert data["action"].std(0).min() > 0.4
    assert lengths.sum() <= 6000
    if source == "play":
        starts = starts_of(data)
        pairs = zip(
            cells_of(MAZE_IDS[env_name], starts[:, :2]),
            cells_of(MAZE_IDS[env_name], starts[:, 2:4]),
            strict=True,
        )
        seen = set(pairs)
        assert seen <= set(PLAY_CELLS[env_name])
        assert len(seen) >= 4
        assert len(np.unique(starts[:, :4], axis=0)) == len(starts), "moved in cells"


def test_the_controller_by_hand():
    with closing(make_environment("PointMaze_UMaze-v3")) as env:
        sample = waypoint_sampler(env.unwrapped.maze)

    class Silent:
        def standard_normal(self, size):
            return np.zeros(size)

    # From the upper left cell to the lower left one, whose centres are (-1, 1) and
    # (-1, -1), the way leads through (0, 1): 2 * (0 - -1.2) - 0.4 * 1 = 2, at most 1.
    # Across it 2 * (1 - 1.1) - 0.4 * -0.25 = -0.1.
    observation = np.array([-1.2, 1.1, -1, -1, -1.2, 1.1, 1, -0.25])
    assert sample(observation, Silent()) == pytest.approx([1, -0.1])
    # In the cell before the goal's it goes straight to the goal, here 0.2 away.
    observation = np.array([0.4, 1, 0.6, 1, 0.4, 1, 0, 0])
    assert sample(observation, Silent()) == pytest.approx([0.4, 0])


def test_a_set_is_cached_and_says_what_it_is_made_of(tmp_path, monkeypatch):
    request = {"num_transitions": 700, "cache_dir": tmp_path, "seed": 2}
    data, manifest = load_dataset("pointmaze-medium", "play", **request)
    again, same = load_dataset("pointmaze-medium", "play", **request)
    assert (data == again).all()
    assert manifest == same
    assert manifest["behavior"]["cells"][0] == [[1, 1], [6, 6]]
    assert manifest["normalized_score"] == 100 * manifest["return"]["mean"]
    monkeypatch.setattr("torchrl_osr.lab.data.mazes.ACTION_NOISE", 0.1)
    other, _ = load_dataset("pointmaze-medium", "play", **request)
    assert not (other["action"] == data["action"]).all()


@pytest.mark.parametrize(
    ("env_name", "source", "message"),
    [
        ("pointmaze-umaze", "play", "data=play of pointmaze-umaze; there are: diverse"),
        ("antmaze-umaze", "diverse", "there are: minari"),
        ("hopper", "diverse", "unknown data='diverse'; there are: random, medium"),
    ],
)
def test_sources_that_are_not_there_are_named(env_name, source, message):
    with pytest.raises(ValueError, match=message):
        collect_source(env_name, source, 9)


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
        with pytest.raises(KeyError):
            shortest_path(set(cells), cells[start], cells[goal])
        return
    path = shortest_path(set(cells), cells[start], cells[goal])
    assert (path[0], path[-1]) == (cells[start], cells[goal])
    assert len(path) == steps + 1
    assert all(free[cell] for cell in path)
    moves = np.abs(np.diff(path, axis=0)).sum(axis=-1)
    assert (moves == 1).all()
