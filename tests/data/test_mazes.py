"""The maze data sets: their behaviour, their starts and goals, and their manifests."""

from __future__ import annotations

import json
from contextlib import closing
from importlib.metadata import version

import h5py
import numpy as np
import pytest

from torchrl_osr.data import (
    check_dataset,
    collect_level,
    load_dataset,
    load_local_dataset,
    local,
    make_environment,
)
from torchrl_osr.data.behavior import behavior_policy_path
from torchrl_osr.data.environment import MAZE_IDS
from torchrl_osr.data.levels import behavior_of
from torchrl_osr.data.manifest import sha256_of
from torchrl_osr.data.mazes import PLAY_CELLS, waypoint_sampler
from torchrl_osr.data.partial import PartialCollection

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


@pytest.mark.parametrize(("env_name", "level"), SETS)
def test_nearly_every_episode_reaches_its_goal(env_name, level):
    data, returns, lengths = collect_level(env_name, level, 6000, progress=False)
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


@pytest.mark.parametrize("env_name", PLAY_CELLS)
def test_play_has_its_pairs_of_cells_and_no_others(env_name):
    starts = starts_of(collect_level(env_name, "play", 6000, progress=False).data)
    pairs = zip(
        cells_of(MAZE_IDS[env_name], starts[:, :2]),
        cells_of(MAZE_IDS[env_name], starts[:, 2:4]),
        strict=True,
    )
    seen = set(pairs)
    assert seen <= set(PLAY_CELLS[env_name])
    assert len(seen) >= 4
    assert len(np.unique(starts[:, :4], axis=0)) == len(starts), "moved in their cells"


def test_diverse_covers_the_free_cells():
    data = collect_level("pointmaze-umaze", "diverse", 8000, progress=False).data
    starts = starts_of(data)
    for columns in (starts[:, :2], starts[:, 2:4]):
        # The seven cells of the U.
        assert len(set(cells_of("PointMaze_UMaze-v3", columns))) == 7
    assert (np.linalg.norm(starts[:, :2] - starts[:, 2:4], axis=-1) > 0.45).all()


def test_a_collection_that_is_interrupted_goes_on_to_the_same_rows(tmp_path):
    request = {"env": "pointmaze-medium", "level": "play"}

    def collected(rows, partial=None):
        return collect_level(
            *request.values(), rows, seed=4, progress=False, partial=partial
        )

    whole = collected(3000)
    first = PartialCollection(tmp_path / "parts", request, save_every=1)
    collected(3000, first)
    parts = sorted((tmp_path / "parts").glob("*.npz"))
    for part in parts[len(parts) // 2 :]:
        part.unlink()
    rest = PartialCollection(tmp_path / "parts", request, save_every=1)
    again = collected(3000, rest)
    assert (whole.data == again.data).all()
    assert whole.episode_lengths.tolist() == again.episode_lengths.tolist()


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
    data, manifest = load_local_dataset("pointmaze-medium", "play", **request)
    again, same = load_local_dataset("pointmaze-medium", "play", **request)
    assert (data == again).all()
    assert manifest == same
    name = "pointmaze-medium-play-700-seed2"
    written = json.loads((tmp_path / "local" / name / "manifest.json").read_text())
    assert written == manifest
    assert manifest["env_id"] == "PointMaze_Medium-v3"
    assert manifest["versions"]["gymnasium-robotics"] == version("gymnasium-robotics")
    assert manifest["behavior"]["cells"][0] == [[1, 1], [6, 6]]
    assert manifest["normalized_score"] == 100 * manifest["return"]["mean"]
    monkeypatch.setattr("torchrl_osr.data.mazes.ACTION_NOISE", 0.1)
    other, changed = load_local_dataset("pointmaze-medium", "play", **request)
    assert changed["behavior"]["action_noise"] == 0.1
    assert not (other["action"] == data["action"]).all()


def test_the_request_of_other_tasks_is_what_it_was():
    path = behavior_policy_path("hopper", "medium")
    assert behavior_of("hopper", "medium") == {
        "behavior_sha256": {"medium": sha256_of(path)}
    }
    assert behavior_of("hopper", "random") == {"behavior_sha256": {}}
    request = local.request_of("hopper", "medium", 500, 0)
    assert list(request) == [
        *["format_version", "env_name", "env_id", "level", "num_transitions", "seed"],
        *["behavior_sha256", "versions"],
    ]
    assert set(request["versions"]) == {"numpy", "gymnasium", "mujoco"}


@pytest.mark.parametrize(
    ("env_name", "level", "message"),
    [
        ("pointmaze-umaze", "play", "'play' of pointmaze-umaze; there are: diverse"),
        ("pointmaze-large", "medium", "'medium' .* there are: diverse, play"),
        ("antmaze-umaze", "diverse", "data=minari.*D4RL/antmaze/umaze-v1"),
        ("antmaze-large", "play", "data=minari.*D4RL/antmaze/large-play-v1"),
        ("hopper", "diverse", "unknown level 'diverse'; there are: random"),
    ],
)
def test_levels_that_are_not_there_are_named(env_name, level, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        load_local_dataset(env_name, level, num_transitions=9, cache_dir=tmp_path)
    with pytest.raises(ValueError, match=message):
        collect_level(env_name, level, 9)


def test_d4rls_own_files_of_the_ant_are_refused(tmp_path):
    rng, rows = np.random.default_rng(0), 60
    with h5py.File(tmp_path / "Ant_maze.hdf5", "w") as file:
        file["observations"] = rng.normal(size=(rows, 29)).astype(np.float32)
        file["actions"] = rng.uniform(-0.9, 0.9, (rows, 8)).astype(np.float32)
        file["rewards"] = (np.arange(rows) % 20 == 19).astype(np.float32)
        file["terminals"] = np.arange(rows) % 20 == 19
        file["timeouts"] = np.zeros(rows, bool)
    path = str(tmp_path / "Ant_maze.hdf5")
    data, _ = load_dataset("antmaze-umaze", "d4rl", path=path)
    assert data["observation"].shape == (rows, 29)
    message = "29 observation .*AntMaze_UMaze-v4 has 31 and 8.*hold the goal.*mirrored"
    with pytest.raises(ValueError, match=message):
        load_dataset("antmaze-umaze", "d4rl", path=path, env_id="AntMaze_UMaze-v4")
