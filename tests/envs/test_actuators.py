"""Noisy, late and sticky actions, against hand-made sequences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_osr.envs import ActionDelay, ActionNoise, StickyAction


def executed(env, actions, *, seed=0):
    """What arrives at the recorder when the agent sends ``actions``."""
    env.reset(seed=seed)
    for action in actions:
        env.step(np.full(2, action, np.float32))
    return [float(action[0]) for action in env.unwrapped.actions]


def test_noise_is_in_units_of_the_half_width(recorder):
    env = ActionNoise(recorder(size=4, low=-1.0, high=3.0), 0.05)
    env.reset(seed=0)
    for _ in range(5000):
        env.step(np.full(4, 1.0))
    actions = np.array(env.unwrapped.actions)
    # 0.05 times a half-width of 2; 20,000 draws, five standard errors, no clipping.
    assert actions.std() == pytest.approx(0.1, rel=0.025)
    assert actions.mean() == pytest.approx(1.0, abs=5 * 0.1 / 20_000**0.5)
    assert actions.dtype == env.action_space.dtype


@given(st.floats(0.01, 5), st.floats(-2, 2), st.integers(0, 2**32))
def test_noisy_actions_stay_in_the_box(recorder, std, action, seed):
    env = ActionNoise(recorder(), std)
    env.reset(seed=seed)
    for _ in range(5):
        env.step(np.full(2, action))
    assert all(action in env.action_space for action in env.unwrapped.actions)


def test_delay_by_hand(recorder):
    env = ActionDelay(recorder(), 2)
    sent = [0.1, 0.2, 0.3, 0.4, 0.5]
    expected = pytest.approx([0.0, 0.0, 0.1, 0.2, 0.3])
    assert executed(env, sent) == expected
    # Nothing is left over from one episode to the next.
    assert executed(env, sent) == expected


@given(
    st.lists(st.floats(-1, 1, width=32), max_size=12),
    st.integers(min_value=0, max_value=9),
)
def test_delay_shifts_the_actions(recorder, sent, steps):
    arrived = executed(ActionDelay(recorder(), steps), sent)
    assert arrived == ([0.0] * steps + sent)[: len(sent)]


@pytest.mark.parametrize("make", [ActionDelay, StickyAction])
def test_actions_are_copied(make, recorder):
    env = make(recorder(), 1)
    env.reset(seed=0)
    buffer = np.full(2, 0.5)
    env.step(buffer)
    buffer[:] = 0.9
    env.step(buffer)
    assert (env.unwrapped.actions[1] == 0.5).all()


def test_sticky_by_hand(recorder):
    env = StickyAction(recorder(), 0.5)
    env.reset(seed=0)

    class Scripted:
        draws = iter([0.4, 0.6, 0.1, 0.499, 0.5])

        def random(self):
            return next(self.draws)

    env._generator = Scripted()
    # The first is the agent's without a draw; draws below 0.5 stick, and what sticks is
    # what was executed, 0.3, not what the agent sent in between.
    flags = []
    for action in [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]:
        flags.append(env.step(np.full(2, action))[-1]["disturbed"])
    assert [action[0] for action in env.unwrapped.actions] == [
        *(0.1, 0.1, 0.3, 0.3, 0.3, 0.6)
    ]
    assert flags == [False, True, False, True, True, False]


def test_sticky_probability(recorder):
    env = StickyAction(recorder(), 0.25)
    env.reset(seed=0)
    flags = [env.step(np.zeros(2))[-1]["disturbed"] for _ in range(10_000)]
    # Five standard errors of 0.0043.
    assert np.mean(flags) == pytest.approx(0.25, abs=0.022)


def test_always_sticky_repeats_the_first_action_of_each_episode(recorder):
    env = StickyAction(recorder(), 1.0)
    assert executed(env, [0.25, 0.5, 0.75]) == [0.25] * 3
    assert executed(env, [0.5, 0.75]) == [0.5] * 2


def test_wrong_arguments(recorder):
    with pytest.raises(ValueError, match="std must be a finite number, at least 0"):
        ActionNoise(recorder(), -0.1)
    with pytest.raises(ValueError, match="RescaleAction or ClipAction"):
        ActionNoise(recorder(high=np.inf), 0.1)
    with pytest.raises(
        ValueError, match="steps must be an integer, at least 0; got -1"
    ):
        ActionDelay(recorder(), -1)
    with pytest.raises(ValueError, match="steps must be an integer"):
        ActionDelay(recorder(), True)
    for probability in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="between 0 and 1"):
            StickyAction(recorder(), probability)
