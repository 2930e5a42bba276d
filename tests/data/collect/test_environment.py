"""Tasks of Gymnasium and of gymnasium-robotics, as everything else gets them."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from contextlib import closing

import gymnasium
import numpy as np
import pytest

from torchrl_osr.data import MAZE_IDS, make_environment
from torchrl_osr.data.collect.environment import environment_id

WIDTHS = {"pointmaze": 8, "antmaze": 31}  # goal reached, goal wanted, point or ant


@pytest.mark.parametrize("name", MAZE_IDS)
def test_mazes_observe_a_vector_with_the_goal_in_front(name, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with closing(make_environment(environment_id(name))) as env:
        observation, info = env.reset(seed=3)
        bare = env.unwrapped
        parts = bare.observation_space.spaces
        assert list(parts) == ["achieved_goal", "desired_goal", "observation"]
        assert observation.shape == (WIDTHS[name.split("-")[0]],)
        assert np.array_equal(observation[2:4], bare.goal)
        assert np.array_equal(observation[:2], bare.data.qpos[:2])
        assert np.array_equal(observation[-2:], bare.data.qvel[-2:])
        assert info["success"] is False
        assert (env.action_space.low == -1).all()
        assert (env.action_space.high == 1).all()
    assert list(tmp_path.iterdir()) == [], "the model's file is not left"


def test_an_episode_ends_at_the_goal_with_its_only_reward():
    with closing(make_environment("PointMaze_UMaze-v3")) as env:
        observation, _ = env.reset(seed=0, options={"reset_cell": np.array([1, 1])})
        env.unwrapped.goal[:] = observation[:2] + np.array([0.6, 0])
        rewards = []
        for _ in range(100):
            _, reward, terminated, truncated, info = env.step(np.float32([0.3, 0]))
            rewards.append(float(reward))
            assert info["success"] is bool(terminated) is bool(reward)
            if terminated:
                break
    assert not truncated
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    assert len(rewards) > 1


def test_an_episode_that_misses_the_goal_ends_with_the_time():
    with closing(make_environment("PointMaze_UMaze-v3")) as env:
        env.reset(seed=0)
        for step in range(300):
            _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
            assert (reward, terminated, info["success"]) == (0, False, False)
            assert truncated == (step == 299)


IN_A_FRESH_PROCESS = """
import sys, warnings
from torchrl_osr.data import make_environment

warnings.simplefilter("error")
make_environment("Hopper-v5")
assert "gymnasium_robotics" not in sys.modules
sys.modules["gymnasium_robotics"] = None  # as if it were not installed
make_environment("Walker2d-v5")
try:
    make_environment("PointMaze_UMaze-v3")
except ImportError as error:
    print(error)
del sys.modules["gymnasium_robotics"]
make_environment("AntMaze_UMaze-v4")
assert "gymnasium_robotics" in sys.modules
"""


def test_robotics_is_imported_for_its_own_tasks_and_says_nothing():
    completed = subprocess.run(
        [sys.executable, "-c", IN_A_FRESH_PROCESS], capture_output=True, text=True
    )
    assert completed.returncode == 0, completed.stderr
    assert completed.stderr == "", "neither notes nor warnings"
    (line,) = completed.stdout.splitlines()
    assert line.startswith("Gymnasium itself has no 'PointMaze_UMaze-v3'")
    assert line.endswith("pip install torchrl-osr[mazes]")


def test_unknown_ids_are_gymnasiums_errors():
    with pytest.raises(gymnasium.error.NameNotFound, match="Hoper"):
        make_environment("Hoper-v5")
    with pytest.raises(gymnasium.error.VersionNotFound, match="v99"):
        make_environment("Hopper-v99")
    with pytest.raises(ValueError, match=r"'ant'.*hopper.*pointmaze-umaze"):
        environment_id("ant")


def test_other_action_bounds_are_rescaled():
    with closing(make_environment("InvertedPendulum-v5")) as env:
        assert (env.action_space.low, env.action_space.high) == (-1, 1)
        assert env.unwrapped.action_space.high == 3
        env.reset(seed=0)
        env.step(np.float32([0.5]))
        assert env.unwrapped.data.ctrl == pytest.approx([1.5])


def test_tasks_without_vectors_are_refused():
    with pytest.raises(ValueError, match=r"CartPole-v1 has actions Discrete\(2\)"):
        make_environment("CartPole-v1")


def test_nothing_is_left_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_environment("HalfCheetah-v5").close()
    assert list(tmp_path.iterdir()) == []
