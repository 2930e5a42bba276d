from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_osr.lab.data import check_dataset, collect_transitions
from torchrl_osr.lab.data.behavior import load_behavior_card
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
    assert returns.tolist() == [2.0, 2.0]
    assert returns.dtype == np.float64
    assert lengths.tolist() == [4, 4]


def test_the_stored_action_is_the_executed_one_and_invertible() -> None:
    env = CountingEnv()
    data, *_ = collect_transitions(env, [saturated], 10, progress=False)
    assert torch.equal(data["action"], torch.from_numpy(np.stack(env.executed)))
    assert data["action"].max() == torch.tensor(ACTION_LIMIT)
    assert torch.isfinite(torch.atanh(data["action"])).all()


def test_shares_are_equal_and_cut_apart() -> None:
    samplers = [lambda _, rng, v=v: np.float32([v]) for v in (-0.5, 0.25, 0.5)]
    data, *_ = collect_transitions(CountingEnv(), samplers, 10, progress=False)
    assert data["action"].flatten().tolist() == [-0.5] * 3 + [0.25] * 3 + [0.5] * 4
    truncated = data["next", "truncated"].flatten()
    assert truncated.nonzero().flatten().tolist() == [2, 5]


@pytest.mark.parametrize("env_name", load_behavior_card())
@pytest.mark.parametrize("source", BEHAVIORS)
def test_named_sets_are_sound(env_name: str, source: str) -> None:
    data, _, lengths = collect_source(env_name, source, 800, progress=False)
    assert data.shape == (800,)
    check_dataset(data)
    assert data["action"].abs().max() <= torch.tensor(ACTION_LIMIT)
    within = ~data["next", "done"].flatten()[:-1]
    following, observation = data["next", "observation"][:-1], data["observation"][1:]
    assert torch.equal(following[within], observation[within])
    # Where an episode ends, the next row starts from a reset.
    assert (following[~within] != observation[~within]).any(dim=-1).all()
    assert int(lengths.sum()) <= 800


def test_time_out_is_truncation() -> None:
    data, returns, lengths = collect_source("halfcheetah", "random", 1500)
    assert not data["next", "terminated"].any()
    ends = data["next", "truncated"].flatten().nonzero().flatten()
    assert ends.tolist() == [999, 1499]
    assert lengths.tolist() == [1000]
    reward = data["next", "reward"][:1000].double().sum().item()
    assert returns == pytest.approx([reward], rel=1e-5)


def test_same_seed_same_data_whatever_the_global_generators() -> None:
    first = collect_source("hopper", "medium-replay", 400, seed=5)
    np.random.seed(1)  # noqa: NPY002  the legacy global state is what is disturbed
    torch.manual_seed(1)
    second = collect_source("hopper", "medium-replay", 400, seed=5)
    other = collect_source("hopper", "medium-replay", 400, seed=6)
    assert (first.data == second.data).all()
    np.testing.assert_array_equal(first.episode_returns, second.episode_returns)
    assert not torch.equal(first.data["observation"], other.data["observation"])


@pytest.mark.parametrize(
    ("env_name", "source", "transitions"),
    [
        ("hopper", "expert", 4000),
        ("hopper", "medium", 6000),
        ("walker2d", "expert", 4000),
        ("halfcheetah", "expert", 3000),
    ],
)
def test_returns_are_near_the_card(
    env_name: str, source: str, transitions: int
) -> None:
    result = collect_source(env_name, source, transitions, progress=False)
    card = load_behavior_card()[env_name]["policies"][source]
    # Loose: few episodes of chaotic dynamics, of which a rare one falls early.
    assert np.median(result.episode_returns) == pytest.approx(
        card["stochastic_return"][0], rel=0.2
    )
