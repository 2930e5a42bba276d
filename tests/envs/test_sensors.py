"""Noise that only the agent sees, with the stated standard deviation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_osr.data import make_environment
from torchrl_osr.envs import ObservationNoise

DRAWS = 20_000


def noise_of(env, play):
    """What 20,000 observations are off by; the recorder's are the step's number."""
    observations = np.array([step[0] for step in play(env, DRAWS)])
    return observations - np.arange(1, DRAWS + 1)[:, None]


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
def test_noise_has_the_stated_deviation_in_every_dimension(kind, play, recorder):
    unit = [1.0, 0.5, 0.0]
    env = ObservationNoise(recorder(sensors=3), 0.2, kind=kind, unit=unit)
    noise = noise_of(env, play)
    # The standard error of a standard deviation is 1/sqrt(2n) = 0.5 % (a uniform one's
    # is less), that of a mean std/sqrt(n): five of each.
    np.testing.assert_allclose(noise.std(0), [0.2, 0.1, 0.0], rtol=0.025, atol=1e-9)
    np.testing.assert_allclose(noise.mean(0), 0, atol=5 * 0.2 / DRAWS**0.5)
    assert abs(np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]) < 5 / DRAWS**0.5
    assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 5 / DRAWS**0.5
    # Within 3**0.5 * 0.2, and reaching for it; a Gaussian goes beyond.
    largest = np.abs(noise[:, 0]).max() / 0.2
    assert 1.7 < largest <= 3**0.5 if kind == "uniform" else largest > 3


def test_the_state_is_left_alone():
    env, bare = (make_environment("HalfCheetah-v5") for _ in range(2))
    env = ObservationNoise(env, 0.3)
    seen, _ = env.reset(seed=2)
    clean, _ = bare.reset(seed=2)
    for _ in range(100):
        assert (seen != clean).all()
        assert (env.unwrapped.data.qpos == bare.unwrapped.data.qpos).all()
        seen, reward, *_ = env.step(env.action_space.high)
        clean, clean_reward, *_ = bare.step(env.action_space.high)
        assert reward == clean_reward


def test_first_observation_is_noisy_and_dtypes_are_kept(recorder):
    bare = recorder(sensors=2)
    bare._observe = lambda: np.zeros(2, np.float32)
    env = ObservationNoise(bare, 0.3)
    first, info = env.reset(seed=0)
    assert (first != 0).all()
    assert info["disturbed"]
    assert first.dtype == env.step(np.zeros(2))[0].dtype == np.float32


def test_unit_is_copied_and_may_be_a_tensor(recorder):
    unit = torch.ones(2, dtype=torch.float64)
    env = ObservationNoise(recorder(sensors=2), 0.3, unit=unit)
    first, _ = env.reset(seed=0)
    unit.zero_()
    again, _ = env.reset(seed=0)
    assert (first == again).all()
    assert (again != 0).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"std": -0.1}, "std must be a finite number, at least 0, got -0.1"),
        ({"std": float("inf")}, "std must be"),
        ({"kind": "cauchy"}, "kind must be one of .* got 'cauchy'"),
        ({"unit": [1.0]}, r"unit has shape \(1,\), but observations have \(3,\)"),
        ({"unit": [1.0, -1.0, 1.0]}, "unit must be finite and at least 0"),
    ],
)
def test_wrong_arguments(arguments, message, recorder):
    with pytest.raises(ValueError, match=message):
        ObservationNoise(recorder(sensors=3), **({"std": 0.1} | arguments))
