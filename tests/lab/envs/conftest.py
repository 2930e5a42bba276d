"""What the tests of disturbances share: an environment that logs its actions."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest


class Recorder(gymnasium.Env):
    """Observes and pays the number of its steps, falls where it is told to.

    It can be stepped after a fall, as MuJoCo's tasks can.
    """

    def __init__(self, falls=(), *, size=2, low=-1.0, high=1.0, sensors=1) -> None:
        box = gymnasium.spaces.Box
        self.observation_space = box(-np.inf, np.inf, (sensors,), np.float64)
        self.action_space = box(low, high, (size,), np.float32)
        self.falls, self.actions = set(falls), []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.actions = []
        return self._observe(), {}

    def step(self, action):
        self.actions.append(np.array(action))
        steps = len(self.actions)
        return self._observe(), float(steps), steps in self.falls, False, {}

    def _observe(self):
        return np.full(self.observation_space.shape, float(len(self.actions)))


@pytest.fixture(scope="session")
def recorder():
    """Return the class, for any number of environments."""
    return Recorder


@pytest.fixture(scope="session")
def play():
    """Return a function that plays ``steps`` steps and returns what they returned."""

    def run(env, steps, *, seed=0, action=None):
        env.reset(seed=seed)
        if action is None:
            action = np.full(env.action_space.shape, 0.5, np.float32)
        return [env.step(action) for _ in range(steps)]

    return run
