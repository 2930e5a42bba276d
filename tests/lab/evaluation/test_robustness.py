"""Pairs of episodes under disturbances."""

from __future__ import annotations

import json
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.data import load_behavior_policy
from torchrl_osr.lab.envs import (
    ActionKnock,
    DynamicsChange,
    ExternalPush,
    ObservationNoise,
)
from torchrl_osr.lab.evaluation import (
    DataDistance,
    Disturbance,
    deterministic_policy,
    evaluate_paired,
)
from torchrl_osr.modules import tanh_gaussian_actor

LINE = "Line-v0"
LIMIT = 150


class Line(gymnasium.Env):
    """A point on a line that moves by its action, and is shoved once if so asked.

    Beyond 10 it falls. Pays 1 a step.
    """

    size, at = 0.0, -1
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = 0.5 + 0.1 * self.np_random.random(), 0
        return np.array([self.x]), {}

    def step(self, action):
        shoved = self.steps == self.at
        self.x += float(action[0]) + self.size * shoved
        self.steps += 1
        return np.array([self.x]), 1.0, abs(self.x) > 10, False, {"disturbed": shoved}


def to_a_half(observation: torch.Tensor) -> torch.Tensor:
    return (0.5 - observation).clamp(-1, 1)


def shove(name: str, size: float, at: int) -> Disturbance:
    def wrap(env):
        env.unwrapped.size, env.unwrapped.at = size, at
        return env

    return Disturbance(name, "push", wrap)


def test_known_returns_and_recovery():
    gymnasium.register(LINE, Line, max_episode_steps=LIMIT)
    rows = torch.linspace(-1, 1, 1000)[:, None]
    distance = DataDistance(TensorDict({"observation": rows}, [1000]))
    disturbances = [
        shove("six", 6.0, 5),
        shove("deadly", 20.0, 5),
        shove("late", 9.0, LIMIT - 3),
        shove("never", 6.0, LIMIT),
        Disturbance("always", "observation", partial(ObservationNoise, std=0.0)),
    ]
    calls = []
    results = evaluate_paired(
        to_a_half, LINE, disturbances, distance, num_episodes=3, seed=4,
        advance=lambda: calls.append(1),
    )  # fmt: skip
    gymnasium.registry.pop(LINE)
    assert len(calls) == 1 + len(disturbances)
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    clean = results["clean"]
    six, deadly, late, never, always = results["levels"]
    assert clean["returns"] == six["returns"] == [LIMIT] * 3
    assert clean["seeds"] == [4, 5, 6]
    # At 0.5, action 0: shoved to 6.5, then 5.5 ... 0.5, the sixth step is back.
    assert six["recovery_steps"] == [6, 6, 6]
    assert six["disturbed_at"] == [5, 5, 5]
    assert six["survived_knock"] == six["alive_after"] == [True] * 3
    # A fall is no recovery.
    assert deadly["lengths"] == deadly["returns"] == [6] * 3
    assert deadly["survived_knock"] == deadly["alive_after"] == [False] * 3
    assert deadly["recovery_steps"] == [None] * 3
    # The time limit censors.
    assert late["disturbed_at"] == [LIMIT - 3] * 3
    assert late["survived_knock"] == [True] * 3
    assert late["alive_after"] == late["recovery_steps"] == [None] * 3
    assert never["disturbed_at"] == never["survived_knock"] == [None] * 3
    assert always["recovery_steps"] is None


def test_an_environment_that_ignores_its_seed_warns():
    class Deaf(Line):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=None)

    gymnasium.register("Deaf-v0", Deaf, max_episode_steps=3)
    rows = TensorDict({"observation": torch.randn(100, 1)}, [100])
    with pytest.warns(UserWarning, match="Deaf-v0 ignores its seed"):
        evaluate_paired(to_a_half, "Deaf-v0", [], DataDistance(rows), num_episodes=2)
    gymnasium.registry.pop("Deaf-v0")


def play(*disturbances: Disturbance, policy, episodes: int = 4):
    rows = torch.randn(500, 11, generator=torch.Generator().manual_seed(0))
    distance = DataDistance(TensorDict({"observation": rows}, [500]))
    given = {"num_episodes": episodes, "seed": 7}
    return evaluate_paired(policy, "Hopper-v5", disturbances, distance, **given)


def test_strength_zero_is_the_clean_episodes_bit_for_bit():
    actor = tanh_gaussian_actor(11, 3, num_cells=[16])
    results = play(
        Disturbance("push", "push", partial(ExternalPush, force=0.0, duration=5)),
        Disturbance("noise", "observation", partial(ObservationNoise, std=0.0)),
        Disturbance("heavy", "dynamics", partial(DynamicsChange, mass=2.0)),
        # After the heavy one: nothing of it may be left.
        Disturbance("mass", "dynamics", partial(DynamicsChange, mass=1.0)),
        policy=deterministic_policy(actor),
    )
    levels = {each["name"]: each for each in results["levels"]}
    for name, each in levels.items():
        same = each["returns"] == results["clean"]["returns"]
        assert same == (name != "heavy"), name
        assert each["seeds"] == results["clean"]["seeds"]
    moments = {name: each["disturbed_at"] for name, each in levels.items()}
    assert moments["heavy"] == [0] * 4
    assert moments["push"] == moments["noise"] == [None] * 4


def test_an_episode_depends_on_its_own_disturbance_alone():
    """Others end at other times then: the rounding of the policy must not notice."""
    behavior = load_behavior_policy("hopper", "replay_8")

    def policy(observation: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(behavior.deterministic(observation.numpy()))

    # Who is knocked early falls while the others, some never knocked, walk on.
    wrap = partial(ActionKnock, steps=20, mode="torque", at=(9, 900))
    results = play(Disturbance("knock", "knock", wrap), policy=policy, episodes=8)
    (knocked,) = results["levels"]
    met = [moment is not None for moment in knocked["disturbed_at"]]
    assert 0 < sum(met) < 8, "the test needs both kinds of episodes"
    pairs = zip(knocked["returns"], results["clean"]["returns"], strict=True)
    assert [one != other for one, other in pairs] == met
