"""What the tests of disturbances share: an environment that logs its actions."""

from __future__ import annotations

import gymnasium
import numpy as np


class Recorder(gymnasium.Env):
    """Observes and pays the number of its steps, falls where it is told to.

    It can be stepped after a fall, as MuJoCo's tasks can.
    """

    def __init__(self, falls=(), *, size=2, low=-1.0, high=1.0, sensors=1) -> None:
        box = gymnasium.spaces.Box
        self.observation_space = box(-np.inf, np.inf, (sensors,), np.float64)
        self.action_space = box(low, high, (size,), np.float32)
        self.falls, self.actions = set(falls), []
        self.info = {}  # always the same one

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.actions = []
        return self._observe(), self.info

    def step(self, action):
        self.actions.append(np.array(action))
        steps = len(self.actions)
        return self._observe(), float(steps), steps in self.falls, False, self.info

    def _observe(self):
        return np.full(self.observation_space.shape, float(len(self.actions)))


def play(env, steps):
    """Play ``steps`` steps with actions of 0.5; return what they returned."""
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.5, np.float32)
    return [env.step(action) for _ in range(steps)]
