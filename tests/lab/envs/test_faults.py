"""Noisy, late and repeated actions, and noisy observations, against numbers by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr.lab.envs import (
    ActionDelay,
    ActionNoise,
    ObservationNoise,
    StickyAction,
)

DRAWS = 20_000


def executed(env, actions, *, seed=0):
    """What arrives at the recorder when the agent sends ``actions``."""
    env.reset(seed=seed)
    for action in actions:
        env.step(np.full(2, action, np.float32))
    return [float(action[0]) for action in env.unwrapped.actions]


def test_action_noise_is_in_units_of_the_half_width(recorder):
    env = ActionNoise(recorder(size=4, low=-1.0, high=3.0), 0.05)
    env.reset(seed=0)
    for _ in range(5000):
        env.step(np.full(4, 1.0))
    actions = np.array(env.unwrapped.actions)
    # 0.05 times a half-width of 2; 20,000 draws, five standard errors, no clipping.
    assert actions.std() == pytest.approx(0.1, rel=0.025)
    assert actions.mean() == pytest.approx(1.0, abs=5 * 0.1 / DRAWS**0.5)
    assert actions.dtype == env.action_space.dtype


@given(
    st.lists(st.floats(-1, 1, width=32), max_size=12),
    st.integers(min_value=0, max_value=9),
)
def test_delay_shifts_the_actions(recorder, sent, steps):
    env = ActionDelay(recorder(), steps)
    for _ in range(2):  # nothing is left over from one episode to the next
        assert executed(env, sent) == ([0.0] * steps + sent)[: len(sent)]


@pytest.mark.parametrize(("make", "strength"), [(ActionDelay, 1), (StickyAction, 0.99)])
def test_actions_are_copied(make, strength, recorder):
    env = make(recorder(), strength)
    env.reset(seed=0)
    buffer = np.full(2, 0.5)
    env.step(buffer)
    buffer[:] = 0.9
    env.step(buffer)
    assert (env.unwrapped.actions[1] == 0.5).all()


def test_sticky_by_hand(recorder):
    env = StickyAction(recorder(), 0.5)
    env.reset(seed=0)
    draws = iter([0.4, 0.6, 0.1, 0.499, 0.5])
    env.sticky.env.np_random = SimpleNamespace(
        uniform=lambda: next(draws), integers=lambda low, high: low
    )
    # The first is the agent's without a draw; draws below 0.5 stick, and what sticks is
    # what was executed, 0.3, not what the agent sent in between.
    sent = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    flags = [env.step(np.full(2, each))[-1]["disturbed"] for each in sent]
    executed = [float(action[0]) for action in env.unwrapped.actions]
    assert executed == [0.1, 0.1, 0.3, 0.3, 0.3, 0.6]
    assert flags == [False, True, False, True, True, False]


def test_observation_noise_has_the_stated_deviation(play, recorder):
    env = ObservationNoise(recorder(sensors=3), 0.2, unit=[1.0, 0.5, 0.0])
    observations = np.array([step[0] for step in play(env, DRAWS)])
    # The recorder observes the number of the step.
    noise = observations - np.arange(1, DRAWS + 1)[:, None]
    # The standard error of a standard deviation is 1/sqrt(2n) = 0.5 %, that of a mean
    # std/sqrt(n): five of each.
    np.testing.assert_allclose(noise.std(0), [0.2, 0.1, 0.0], rtol=0.025, atol=1e-9)
    np.testing.assert_allclose(noise.mean(0), 0, atol=5 * 0.2 / DRAWS**0.5)
    assert abs(np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]) < 5 / DRAWS**0.5
    assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 5 / DRAWS**0.5
