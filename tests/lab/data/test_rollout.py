"""Rolled-out sets: the rows and the behaviours."""

from __future__ import annotations

from contextlib import closing

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_osr.lab.data import check_dataset, collect_transitions, make_environment
from torchrl_osr.lab.data.behavior import load_behavior_card
from torchrl_osr.lab.data.environment import MAZE_IDS, TEST_CELLS
from torchrl_osr.lab.data.mazes import PLAY_CELLS
from torchrl_osr.lab.data.rollout import BEHAVIORS, collect_source
from torchrl_osr.lab.data.transitions import ACTION_LIMIT


class CountingEnv(gymnasium.Env):
    """Observes [episode, step]; ends after four steps, every other time by time-out."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        self.episode, self.step_count, self.executed = 0, 0, []

    def reset(self, *, seed=None, options=None):
        self.episode, self.step_count = self.episode + 1, 0
        return np.array([self.episode, 0.0]), {}

    def step(self, action):
        self.executed.append(action)
        self.step_count += 1
        end = self.step_count == 4
        timeout = end and self.episode % 2 == 0
        observation = np.array([self.episode, self.step_count], dtype=np.float64)
        return observation, 0.5, end and not timeout, timeout, {}


def saturated(observation, rng):
    observation[:] = -1  # a policy may write into what it is given
    return np.ones(1, dtype=np.float32)


def test_rows_of_a_counting_environment() -> None:
    env = CountingEnv()
    data, returns, lengths = collect_transitions(env, [saturated], 10, progress=False)
    check_dataset(data)
    observation, following = data["observation"], data["next", "observation"]
    assert observation[:, 0].tolist() == [1] * 4 + [2] * 4 + [3] * 2
    assert observation[:, 1].tolist() == [0, 1, 2, 3] * 2 + [0, 1]
    # The true next observation, also in the rows that end an episode.
    assert following[:, 0].tolist() == observation[:, 0].tolist()
    assert following[:, 1].tolist() == [1, 2, 3, 4] * 2 + [1, 2]
    assert data["next", "terminated"].flatten().nonzero().flatten().tolist() == [3]
    # A time-out, and the last row, which is cut.
    assert data["next", "truncated"].flatten().nonzero().flatten().tolist() == [7, 9]
    assert data["next", "done"].flatten().nonzero().flatten().tolist() == [3, 7, 9]
    assert (returns.tolist(), lengths.tolist()) == ([2.0, 2.0], [4, 4])
    # The stored action is the executed one, and invertible.
    assert torch.equal(data["action"], torch.from_numpy(np.stack(env.executed)))
    assert data["action"].max() == torch.tensor(ACTION_LIMIT)
    assert torch.isfinite(torch.atanh(data["action"])).all()


def test_shares_are_equal_and_cut_apart() -> None:
    samplers = [lambda _, rng, v=v: np.float32([v]) for v in (-0.5, 0.25, 0.5)]
    data, *_ = collect_transitions(CountingEnv(), samplers, 10, progress=False)
    assert data["action"].flatten().tolist() == [-0.5] * 3 + [0.25] * 3 + [0.5] * 4
    truncated = data["next", "truncated"].flatten()
    assert truncated.nonzero().flatten().tolist() == [2, 5]


def check_sound(data) -> None:
    """Rows follow one another; where an episode ends, the next one is a reset."""
    check_dataset(data)
    within = ~data["next", "done"].flatten()[:-1]
    following, observation = data["next", "observation"][:-1], data["observation"][1:]
    assert torch.equal(following[within], observation[within])
    assert (following[~within] != observation[~within]).any(dim=-1).all()


@pytest.mark.parametrize("env_name", load_behavior_card())
@pytest.mark.parametrize("source", BEHAVIORS)
def test_named_sets_are_sound(env_name: str, source: str) -> None:
    data, _, lengths = collect_source(env_name, source, 800, progress=False)
    assert data.shape == (800,)
    check_sound(data)
    assert int(lengths.sum()) <= 800


def test_same_seed_same_data_whatever_the_global_generators() -> None:
    first = collect_source("hopper", "medium-replay", 400, seed=5)
    np.random.seed(1)  # noqa: NPY002  the legacy global state is what is disturbed
    torch.manual_seed(1)
    second = collect_source("hopper", "medium-replay", 400, seed=5)
    other = collect_source("hopper", "medium-replay", 400, seed=6)
    assert (first[0] == second[0]).all()
    np.testing.assert_array_equal(first[1], second[1])
    assert not torch.equal(first[0]["observation"], other[0]["observation"])


@pytest.mark.parametrize("env_name", ["hopper", "halfcheetah"])
def test_returns_are_near_the_card(env_name: str) -> None:
    _, returns, _ = collect_source(env_name, "expert", 4000, progress=False)
    card = load_behavior_card()[env_name]["policies"]["expert"]
    # Loose: few episodes of chaotic dynamics, of which a rare one falls early.
    assert np.median(returns) == pytest.approx(card["stochastic_return"][0], rel=0.2)


def check_maze(data, env_id):
    """Check rows and rewards; return starts, and pairs of cells, of start and goal."""
    check_sound(data)
    reward, terminated = data["next", "reward"], data["next", "terminated"]
    assert ((reward == 1) == terminated).all()
    assert ((reward == 0) | (reward == 1)).all()
    first = np.r_[True, data["next", "done"].flatten()[:-1]]
    starts = data["observation"].numpy()[first]
    with closing(make_environment(env_id)) as env:
        cell = env.unwrapped.maze.cell_xy_to_rowcol
        cells = [tuple(cell(xy).tolist()) for xy in starts[:, :4].reshape(-1, 2)]
    return starts, {*zip(cells[::2], cells[1::2], strict=True)}


@pytest.mark.parametrize("source", ["diverse", "play"])
def test_nearly_every_episode_reaches_its_goal(source):
    name = "pointmaze-large" if source == "play" else "pointmaze-umaze"
    data, returns, _ = collect_source(name, source, 6000, progress=False)
    starts, pairs = check_maze(data, MAZE_IDS[name])
    assert len(returns) >= 15
    assert returns.mean() > 0.95
    # The goal stays, and the noise leaves most of the actions inside of their bounds.
    assert (data["observation"][:, 2:4] == data["next", "observation"][:, 2:4]).all()
    assert (data["action"].abs() > 0.998).float().mean() < 0.3
    assert data["action"].std(0).min() > 0.4
    if source == "play":
        assert pairs <= set(PLAY_CELLS["large"])
        assert len(np.unique(starts[:, :4], axis=0)) == len(starts), "moved in cells"


@pytest.mark.parametrize("source", ["umaze", "diverse"])
def test_most_ants_reach_their_goal_and_a_time_out_is_no_terminal(source):
    data, returns, lengths = collect_source("antmaze-umaze", source, 5000, seed=2)
    _, pairs = check_maze(data, MAZE_IDS["antmaze-umaze"])
    assert set(returns) <= {0, 1}
    assert returns.mean() > 0.5
    # Without the goal an episode lasts 700 steps, and its end is a time-out.
    assert set(lengths[returns == 0]) == {700}
    terminated, truncated = data["next", "terminated"], data["next", "truncated"]
    assert (data["next", "done"] == terminated | truncated).all()
    assert truncated.sum() >= (returns == 0).sum()
    assert (pairs == {TEST_CELLS["umaze"]}) == (source == "umaze")
