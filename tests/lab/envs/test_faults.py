"""Actuators and sensors against numbers by hand; simulations against MuJoCo's own."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lab.envs.recorder import Recorder, play

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.envs import (
    ActionDelay,
    DynamicsChange,
    ObservationNoise,
    StartStateNoise,
)

DRAWS = 20_000


def executed(env, actions):
    """What arrives at the recorder when the agent sends ``actions``."""
    env.reset(seed=0)
    for action in actions:
        env.step(np.full(2, action, np.float32))
    return [float(action[0]) for action in env.unwrapped.actions]


@given(st.lists(st.floats(-1, 1, width=32), max_size=12), st.integers(0, 9))
def test_delay_shifts_the_actions(sent, steps):
    env = ActionDelay(Recorder(), steps)
    for _ in range(2):  # nothing is left over from one episode to the next
        assert executed(env, sent) == ([0.0] * steps + sent)[: len(sent)]


def test_actions_are_copied():
    env = ActionDelay(Recorder(), 1)
    env.reset(seed=0)
    buffer = np.full(2, 0.5)
    env.step(buffer)
    buffer[:] = 0.9
    env.step(buffer)
    assert (env.unwrapped.actions[1] == 0.5).all()


def test_observation_noise_has_the_stated_deviation():
    env = ObservationNoise(Recorder(sensors=3), 0.2, unit=[1.0, 0.5, 0.0])
    observations = np.array([step[0] for step in play(env, DRAWS)])
    # The recorder observes the number of the step.
    noise = observations - np.arange(1, DRAWS + 1)[:, None]
    # The standard error of a standard deviation is 1/sqrt(2n) = 0.5 %, that of a mean
    # std/sqrt(n): five of each.
    np.testing.assert_allclose(noise.std(0), [0.2, 0.1, 0.0], rtol=0.025, atol=1e-9)
    np.testing.assert_allclose(noise.mean(0), 0, atol=5 * 0.2 / DRAWS**0.5)
    assert abs(np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]) < 5 / DRAWS**0.5
    assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 5 / DRAWS**0.5


@pytest.mark.parametrize("factor", [0.05, 0.7, 20.0])
def test_masses_and_inertia_are_those_of_mujocos_total_mass(factor):
    witness = copy.deepcopy(make_environment("Walker2d-v5").unwrapped.model)
    env = DynamicsChange(make_environment("Walker2d-v5"), mass=factor)
    mujoco.mj_setTotalmass(witness, factor * witness.body_mass.sum())
    mujoco.mj_setConst(witness, mujoco.MjData(witness))
    names = ["body_mass", "body_inertia", "body_subtreemass", "body_invweight0"]
    for name in (*names, "dof_invweight0", "dof_M0"):
        ours, theirs = getattr(env.unwrapped.model, name), getattr(witness, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, err_msg=name)


def starts(env, number):
    """Positions and velocities of ``number`` start states, ``[number, nq + nv]``."""
    states = []
    for seed in range(number):
        env.reset(seed=seed)
        states.append(env.unwrapped.state_vector())
    return np.array(states)


def test_noise_has_the_stated_deviation_around_the_bare_start():
    noisy = starts(StartStateNoise(make_environment("Hopper-v5"), 0.1), 400)
    noise = noisy - starts(make_environment("Hopper-v5"), 400)
    # 4,800 draws: the standard error of a standard deviation is 1 %, take four; that of
    # one of 12 means is 0.1/20.
    assert noise.std() == pytest.approx(0.1, rel=0.04)
    assert np.abs(noise.mean(0)).max() < 4 * 0.1 / 20
    covariance = np.corrcoef(noise.T) - np.eye(12)
    assert np.abs(covariance).max() < 4.5 / 20


@pytest.mark.parametrize("name", ["Hopper-v5", "Ant-v5"])
def test_everything_follows_from_the_new_state(name):
    env = StartStateNoise(make_environment(name), 0.1)
    observation, info = env.reset(seed=0)
    bare = env.unwrapped
    assert (observation == bare._get_obs()).all()
    assert info["x_position"] == bare.data.qpos[0]
    fresh = mujoco.MjData(bare.model)
    fresh.qpos[:], fresh.qvel[:] = bare.data.qpos, bare.data.qvel
    mujoco.mj_forward(bare.model, fresh)
    np.testing.assert_allclose(bare.data.xpos, fresh.xpos, atol=1e-12)
    np.testing.assert_allclose(bare.data.qacc, fresh.qacc, rtol=1e-4, atol=1e-4)
