"""Knocks and pushes against sequences by hand and the released sampler."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lab.envs.recorder import Recorder, play

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.envs import ActionKnock, DynamicsChange, ExternalPush

MODES = st.sampled_from(["official", "paper", "torque"])


def column(steps, index):
    return [step[index] for step in steps]


def flags(steps):
    return [step[-1]["disturbed"] for step in steps]


def test_official_by_hand():
    # Steps 1, 2, 3 are the agent's, 4 to 8 the knock's, 9 and 10 the agent's again. It
    # falls in step 5, within the knock, which nobody hears of, and in step 10.
    env = ActionKnock(Recorder(falls=[5, 10]), 5, mode="official", at=3)
    played = play(env, 5)
    assert [float(step[0][0]) for step in played] == [1, 2, 8, 9, 10]
    assert column(played, 1) == [1, 2, 3, 9, 10]
    assert column(played, 2) == [False, False, False, False, True]
    assert flags(played) == [False, False, True, False, False]


def test_official_goes_through_the_users_wrappers():
    env = gymnasium.wrappers.TimeLimit(Recorder(sensors=2), 5)
    box = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    env = gymnasium.wrappers.TransformObservation(env, lambda seen: seen[:1] / 10, box)
    played = play(ActionKnock(env, 5, mode="official", at=3), 5)
    assert [step[0].tolist() for step in played] == [[0.1], [0.2], [0.8], [0.9], [1.0]]
    assert column(played, 3) == [False] * 4 + [True]


@pytest.mark.parametrize("fall", [2, 3])
def test_official_spares_who_fell_before(fall):
    bare = Recorder(falls=[fall])
    env = ActionKnock(bare, 5, mode="official", at=3)
    played = play(env, fall)
    assert played[-1][2]
    assert len(bare.actions) == fall
    assert not any(flags(played))


def sampler(env, policy, observation, shakes, *, at, steps):
    """The released TrajSampler's loop, on an environment without time limit."""
    observations, rewards = [], []
    for ii in range(steps):
        if ii > 0 and ii == at:
            for shake in shakes:
                observation, *_ = env.step(shake)
        action = policy(observation)
        next_observation, reward, done, _, _ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        observation = next_observation
        if done:
            break
    return np.array(observations), np.array(rewards)


@pytest.mark.parametrize("name", ["HalfCheetah-v5", "Hopper-v5"])
def test_official_is_the_released_sampler(name):
    at = {"HalfCheetah-v5": 500, "Hopper-v5": 8}[name]
    env = ActionKnock(make_environment(name), 15, mode="official", at=at)
    size = env.action_space.shape[0]

    def policy(observation):
        return np.tanh(observation[:size] * 3)

    shakes, observations, rewards = [], [], []
    bare_step = env.unwrapped.step
    env.unwrapped.step = lambda action: shakes.append(action) or bare_step(action)
    observation, _ = env.reset(seed=1)
    over = False
    while not over:
        observations.append(observation)
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        rewards.append(reward)
        over = terminated or truncated
    assert len(shakes) == len(rewards) + 15
    assert len(rewards) > at + 1, "it shall play on after the knock"

    other = make_environment(name)
    start, _ = other.reset(seed=1)
    shakes = shakes[at : at + 15]
    theirs = sampler(other.unwrapped, policy, start, shakes, at=at, steps=1000)
    assert (np.array(observations) == theirs[0]).all()
    assert (np.array(rewards) == theirs[1]).all()


@pytest.mark.parametrize("mode", ["paper", "torque"])
def test_counted_modes_replace_the_agents_actions(mode):
    bare = Recorder(falls=[9])
    played = play(ActionKnock(bare, 3, mode=mode, at=4), 9)
    own = [(action == 0.5).all() for action in bare.actions]
    assert own == [True] * 4 + [False] * 3 + [True] * 2
    assert column(played, 1) == [*range(1, 10)], "all steps are paid"
    assert column(played, 2) == [False] * 8 + [True]
    assert flags(played) == [False] * 4 + [True] * 3 + [False] * 2
    assert bare.actions[5].dtype == bare.action_space.dtype
    if mode == "torque":
        assert set(np.unique(bare.actions[4:7])) == {-1, 1}


@given(st.integers(1, 30), st.integers(1, 20), st.integers(0, 2**40), MODES)
@settings(max_examples=25)
def test_moments_lie_in_the_window_and_follow_seeds(start, width, seed, mode):
    window = (start, start + width)
    env = ActionKnock(Recorder(), 2, mode=mode, at=window)
    moments = []
    for _ in range(2):
        env.reset(seed=seed)
        flags = [env.step(np.zeros(2))[-1]["disturbed"] for _ in range(sum(window))]
        # Official: within the agent's last step before the moment.
        moments.append(flags.index(True) + (mode == "official"))
        assert sum(flags) == (1 if mode == "official" else 2)
    assert start <= moments[0] < start + width
    assert moments[0] == moments[1]


def test_force_is_applied_and_removed():
    env = ExternalPush(make_environment("Hopper-v5"), 0.5, duration=3, at=2)
    bare, seen = env.unwrapped, []
    step = bare.step
    bare.step = lambda a: seen.append(bare.data.xfrc_applied.copy()) or step(a)
    assert flags(play(env, 7)) == [False] * 2 + [True] * 3 + [False] * 2
    torso = mujoco.mj_name2id(bare.model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    for number, applied in enumerate(seen):
        expected = np.zeros_like(applied)
        expected[torso, 0] = env.force * env.sign * (2 <= number < 5)
        assert (applied == expected).all()
    # Gymnasium's model, weighed: its mass times 9.81 m/s².
    assert env.force == pytest.approx(0.5 * 155.19, abs=0.01)
    heavy = DynamicsChange(make_environment("Hopper-v5"), mass=3.0)
    push = ExternalPush(heavy, 1.0, duration=1)
    assert push.force == pytest.approx(3 * 155.19, abs=0.05)
