"""Which disturbances fit a maze, whose simulation is in an environment inside it."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from torchrl_osr.data import make_environment
from torchrl_osr.envs import (
    ActionKnock,
    ActionNoise,
    DynamicsChange,
    ExternalPush,
    ObservationNoise,
    StartStateNoise,
)
from torchrl_osr.evaluation import Recorder

ENV = "PointMaze_UMaze-v3"


def push(env):
    return ExternalPush(env, 1.0, duration=5)


@pytest.mark.parametrize("mode", ["official", "paper", "torque"])
def test_knocks_fit(mode):
    with closing(ActionKnock(make_environment(ENV), 5, mode=mode, at=3)) as env:
        observation, _ = env.reset(seed=0)
        for _ in range(10):
            observation, *_, info = env.step(np.zeros(2, np.float32))
            assert observation.shape == (8,)
            # As the environment lies now, also right after the official knock.
            inside = env.unwrapped.point_env.data
            assert np.array_equal(observation[:2], inside.qpos)
            assert np.array_equal(observation[-2:], inside.qvel)
        assert info["knock_steps"] == 0


@pytest.mark.parametrize("wrapper", [ActionNoise, ObservationNoise])
def test_noise_fits(wrapper):
    with closing(wrapper(make_environment(ENV), 0.1)) as env:
        env.reset(seed=0)
        observation, *_, info = env.step(np.zeros(2, np.float32))
    assert observation.shape == (8,)
    assert info["disturbed"]


@pytest.mark.parametrize(
    ("wrap", "error", "message"),
    [
        (push, ValueError, "body must be one of .*particle.*got 'torso'"),
        (lambda env: StartStateNoise(env, 0.1), TypeError, "StartStateNoise sets"),
        (lambda env: DynamicsChange(env, mass=2), TypeError, "DynamicsChange sets"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(wrap, error, message):
    with (
        closing(make_environment(ENV)) as env,
        pytest.raises(error, match=message),
    ):
        wrap(env)


def test_who_reaches_the_goal_has_not_fallen():
    recorder = Recorder(2)
    for episode, success in enumerate((True, False)):
        recorder(episode, np.zeros(8), True, {"success": success})
    assert [each.terminated for each in recorder.trajectories] == [False, True]
