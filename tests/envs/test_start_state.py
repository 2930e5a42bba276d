"""Noise on start states: its size, what follows from it, and free bodies."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_osr.data import make_environment
from torchrl_osr.envs import StartStateNoise


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


def test_orientations_stay_orientations():
    env, bare = (
        StartStateNoise(make_environment("Ant-v5"), 0.5),
        make_environment("Ant-v5"),
    )
    env.reset(seed=0)
    bare.reset(seed=0)
    quaternion, clean = (each.unwrapped.data.qpos[3:7] for each in (env, bare))
    assert np.linalg.norm(quaternion) == pytest.approx(1)
    assert abs(quaternion @ clean / np.linalg.norm(clean)) < 0.999


def test_negative_std_is_an_error():
    with pytest.raises(ValueError, match="std must be a finite number, at least 0"):
        StartStateNoise(make_environment("Hopper-v5"), -0.1)
