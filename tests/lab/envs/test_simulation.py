"""Changed dynamics and start states, against MuJoCo's own numbers."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.envs import DynamicsChange, StartStateNoise

DERIVED = ["body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"]
BARE = make_environment("Walker2d-v5").unwrapped.model
factors = st.floats(0.05, 20)


def same(one, other, *, but=()):
    """Whether two models have the same numbers, up to the named arrays."""
    names = [
        name
        for name in dir(one)
        if isinstance(getattr(one, name, None), np.ndarray) and name not in but
    ]
    assert len(names) > 100
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in names)


@given(factors)
@settings(deadline=None, max_examples=10)
def test_masses_and_inertia_are_those_of_mujocos_total_mass(factor):
    env = DynamicsChange(make_environment("Walker2d-v5"), mass=factor)
    model, witness = env.unwrapped.model, copy.deepcopy(BARE)
    mujoco.mj_setTotalmass(witness, factor * BARE.body_mass.sum())
    mujoco.mj_setConst(witness, mujoco.MjData(witness))
    for name in ("body_mass", "body_inertia", *DERIVED):
        ours, theirs = getattr(model, name), getattr(witness, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, err_msg=name)
    env.close()


def test_factors_do_not_accumulate_and_close_restores_the_model():
    env = make_environment("Walker2d-v5")
    original = env.unwrapped.model
    for _ in range(3):
        wrapped = DynamicsChange(env, mass=2.0, friction=0.5, gravity=0.5)
        for seed in range(3):
            wrapped.reset(seed=seed)
            wrapped.step(wrapped.action_space.low)
            model = env.unwrapped.model
            assert (model.body_mass == 2 * BARE.body_mass).all()
            assert (model.opt.gravity == 0.5 * BARE.opt.gravity).all()
        wrapped.close()
        wrapped.close()
        assert env.unwrapped.model is original
        assert same(original, BARE)


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
