"""Tasks of Gymnasium and of gymnasium-robotics, as everything else gets them."""

from __future__ import annotations

import tempfile
from contextlib import closing

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from torchrl_osr.lab.data import environment, make_environment
from torchrl_osr.lab.data.environment import MAZE_IDS, known_ids

PLANE = spaces.Box(-1, 1, (2,), np.float32)
STATE = spaces.Dict([("speed", spaces.Box(2, 3, (1,))), ("angle", PLANE)])
SPACES = {
    "test/Endless-v0": (PLANE, spaces.Box(-np.inf, np.inf, (1,), np.float32)),
    "test/Fixed-v0": (PLANE, spaces.Box(np.float32([0, 1]), np.float32([1, 1]))),
    "test/Shifted-v0": (PLANE, spaces.Discrete(3, start=-1)),
    "test/Lazy-v0": (PLANE, spaces.Discrete(3)),
    "test/Tuple-v0": (spaces.Tuple([STATE, spaces.Discrete(3)]), PLANE),
}


class Bare(gymnasium.Env):
    """Random observations for ever; the reward is the action."""

    def __init__(self, observations, actions):
        self.observation_space, self.action_space = observations, actions

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), float(action), False, False, {}


@pytest.fixture(scope="module", autouse=True)
def _bare_environments():
    for env_id, (observations, actions) in SPACES.items():
        kwargs = {"observations": observations, "actions": actions}
        gymnasium.register(env_id, Bare, kwargs=kwargs, disable_env_checker=True)
    yield
    for env_id in SPACES:
        del gymnasium.registry[env_id]


WIDTHS = {"pointmaze": 8, "antmaze": 31}  # goal reached, goal wanted, point or ant


@pytest.mark.parametrize("name", MAZE_IDS)
def test_mazes_observe_a_vector_with_the_goal_in_front(name, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with closing(make_environment(known_ids()[name])) as env:
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


@pytest.mark.parametrize(
    ("env_id", "error", "message"),
    [
        ("Hoper-v5", ValueError, r"env.id=Hoper-v5 cannot be made.*Hopper"),
        ("absent:Arm-v0", ImportError, "cannot be made: No module named 'absent'"),
        ("FrozenLake-v1", ValueError, r"has observations Discrete\(16\)"),
        ("test/Endless-v0", ValueError, "expected real numbers, low < high"),
        ("test/Fixed-v0", ValueError, "expected real numbers, low < high"),
        ("test/Shifted-v0", ValueError, "or Discrete from 0"),
    ],
)
def test_what_cannot_be_acted_in_is_refused_in_a_sentence(env_id, error, message):
    with pytest.raises(error, match=message):
        make_environment(env_id)


def test_other_action_bounds_are_rescaled_and_tuples_become_vectors():
    with closing(make_environment("InvertedPendulum-v5")) as env:
        assert (env.action_space.low, env.action_space.high) == (-1, 1)
        env.reset(seed=0)
        env.step(np.float32([0.5]))
        assert env.unwrapped.data.ctrl == pytest.approx([1.5])
    with closing(make_environment("test/Tuple-v0")) as env:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        assert (observation.shape, observation[2] > 1) == ((6,), True), "speed is last"
        entries = ["0.angle[0]", "0.angle[1]", "0.speed[0]", "1[0]", "1[1]", "1[2]"]
        assert env.observation_space.entries == entries


def test_an_episode_that_never_ends_is_cut(monkeypatch):
    monkeypatch.setattr(environment, "MAX_EPISODE", 50)
    with closing(make_environment("test/Lazy-v0")) as env:
        env.reset(seed=0)
        cut = [env.step(np.int64(0))[3] for _ in range(50)]
    assert cut == [False] * 49 + [True]
