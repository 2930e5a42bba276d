"""Pairs of episodes: equal until they are disturbed, and different only then."""

from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr import OSRLoss
from torchrl_osr.lab.data import load_behavior_policy
from torchrl_osr.lab.envs import (
    ActionKnock,
    DynamicsChange,
    ExternalPush,
    ObservationNoise,
    attacked_policy,
    critics_of,
)
from torchrl_osr.lab.evaluation import DataDistance, Disturbance, evaluate_paired
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor

LINE = "Line-v0"
LIMIT = 150


class Line(gymnasium.Env):
    """A point on a line that moves by its action; beyond 10 it falls. Pays 1 a step."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = 0.5 + 0.1 * self.np_random.random()
        return np.array([self.x]), {}

    def step(self, action):
        self.x += float(action[0])
        return np.array([self.x]), 1.0, abs(self.x) > 10, False, {}


class Shove(gymnasium.Wrapper):
    """Moves the point once."""

    def __init__(self, env, size: float, at: int) -> None:
        super().__init__(env)
        self.size, self.at = size, at

    def reset(self, **options):
        self.steps = 0
        return self.env.reset(**options)

    def step(self, action):
        shoved = self.steps == self.at
        self.steps += 1
        self.unwrapped.x += self.size * shoved
        *results, info = self.env.step(action)
        return *results, info | {"disturbed": shoved}


def to_a_half(observation: torch.Tensor) -> torch.Tensor:
    return (0.5 - observation).clamp(-1, 1)


def shove(name: str, size: float, at: int) -> Disturbance:
    return Disturbance(name, "push", size, partial(Shove, size=size, at=at))


@pytest.fixture(scope="module")
def line_results():
    gymnasium.register(LINE, Line, max_episode_steps=LIMIT)
    rows = torch.linspace(-1, 1, 1000)[:, None]
    distance = DataDistance(TensorDict({"observation": rows}, [1000]))
    disturbances = [
        shove("six", 6.0, 5),
        shove("deadly", 20.0, 5),
        shove("late", 9.0, LIMIT - 3),
        shove("never", 6.0, LIMIT),
        Disturbance("always", "observation", 0.0),
    ]
    calls = []
    results = evaluate_paired(
        to_a_half, LINE, disturbances, distance, num_episodes=3, seed=4,
        advance=lambda: calls.append(1),
    )  # fmt: skip
    gymnasium.registry.pop(LINE)
    assert len(calls) == 1 + len(disturbances)
    return results.clean, {each.disturbance.name: each for each in results.disturbed}


def of(results, name: str) -> list:
    """One entry of the recovery of each episode."""
    return [getattr(each, name) for each in results.recovery]


def test_known_returns_and_recovery_steps(line_results):
    clean, disturbed = line_results
    six = disturbed["six"]
    assert clean.returns.tolist() == [LIMIT] * 3
    assert clean.seeds.tolist() == [4, 5, 6]
    # At 0.5, action 0: shoved to 6.5, then 5.5 ... 0.5, the sixth step is back.
    assert of(six, "steps") == [6, 6, 6]
    assert six.disturbed_at == of(six, "ended_at") == [5, 5, 5]
    assert of(six, "survived") == of(six, "alive_after") == [True] * 3
    assert six.results.returns.tolist() == [LIMIT] * 3


def test_who_falls_is_not_back(line_results):
    deadly = line_results[1]["deadly"]
    assert deadly.results.lengths.tolist() == deadly.results.returns.tolist() == [6] * 3
    assert of(deadly, "survived") == of(deadly, "alive_after") == [False] * 3
    assert of(deadly, "steps") == [None] * 3


def test_the_time_limit_censors(line_results):
    late = line_results[1]["late"]
    assert late.disturbed_at == [LIMIT - 3] * 3
    assert of(late, "survived") == [True] * 3
    assert of(late, "alive_after") == of(late, "steps") == [None] * 3


def test_no_disturbance_no_entries(line_results):
    never, always = line_results[1]["never"], line_results[1]["always"]
    assert never.disturbed_at == of(never, "survived") == [None] * 3
    assert always.recovery is None


def linear_policy(observation: torch.Tensor) -> torch.Tensor:
    """Falls after different times; rows do not mix."""
    return torch.tanh(observation[:, :3] * 3)


def hopper_distance() -> DataDistance:
    rows = torch.randn(500, 11, generator=torch.Generator().manual_seed(0))
    return DataDistance(TensorDict({"observation": rows}, [500]))


def play(*disturbances: Disturbance, policy=linear_policy, episodes: int = 4):
    distance = hopper_distance()
    return evaluate_paired(
        policy, "Hopper-v5", disturbances, distance, num_episodes=episodes, seed=7
    )


def test_strength_zero_is_the_clean_episodes_bit_for_bit():
    actor = tanh_gaussian_actor(11, 3, num_cells=[16])
    critics = critics_of(OSRLoss(actor, critic_ensemble(11, 3), recovery_weight=0))
    attack = partial(attacked_policy, actor.get_dist, critics, kind="action_diff")
    bare = attack(epsilon=0.0)
    results = play(
        Disturbance("push", "push", 0.0, partial(ExternalPush, force=0.0, duration=5)),
        Disturbance("noise", "observation", 0.0, partial(ObservationNoise, std=0.0)),
        Disturbance("heavy", "dynamics", 2.0, partial(DynamicsChange, mass=2.0)),
        # After the heavy one: nothing of it may be left.
        Disturbance("mass", "dynamics", 1.0, partial(DynamicsChange, mass=1.0)),
        Disturbance("attack", "attack", 0.0, policy=attack(epsilon=0.0)),
        Disturbance("attacked", "attack", 0.5, policy=attack(epsilon=0.5)),
        policy=bare,
    )
    for each in results.disturbed:
        same = np.array_equal(each.results.returns, results.clean.returns)
        disturbance = each.disturbance
        assert same == (disturbance.strength in (0.0, 1.0)), disturbance.name
        assert each.results.seeds.tolist() == results.clean.seeds.tolist()
    moments = {each.disturbance.name: each.disturbed_at for each in results.disturbed}
    assert moments["attacked"] == moments["heavy"] == [0] * 4
    assert moments["push"] == moments["noise"] == [None] * 4


def test_an_episode_depends_on_its_own_disturbance_alone():
    """Others end at other times then: the rounding of the policy must not notice."""
    behavior = load_behavior_policy("hopper", "replay_8")

    def policy(observation: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(behavior.deterministic(observation.numpy()))

    # Who is knocked early falls while the others, some never knocked, walk on.
    wrap = partial(ActionKnock, steps=20, mode="torque", at="random", window=(9, 900))
    results = play(Disturbance("knock", "knock", 20, wrap), policy=policy, episodes=8)
    (knocked,) = results.disturbed
    met = np.array([moment is not None for moment in knocked.disturbed_at])
    assert 0 < met.sum() < 8, "the test needs both kinds of episodes"
    same = knocked.results.returns == results.clean.returns
    np.testing.assert_array_equal(same, ~met)


@pytest.mark.parametrize(
    ("disturbances", "episodes", "named"),
    [
        ([Disturbance("a", "push", 1.0)], 1, "num_episodes must be at least 2"),
        (
            [Disturbance("a", "push", 1.0), Disturbance("a", "push", 2.0)],
            2,
            r"\['a', 'a'\]",
        ),
        ([], 2, "disturbances need one name each"),
        (
            [
                Disturbance(
                    "b", "push", 1.0, partial(ExternalPush, force=1.0, duration=0)
                )
            ],
            2,
            "'b' is not possible for Hopper-v5: duration",
        ),
    ],
)
def test_bad_input_is_named(disturbances, episodes, named):
    with pytest.raises(ValueError, match=named):
        play(*disturbances, episodes=episodes)
