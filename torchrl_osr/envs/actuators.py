"""Faults of the actuators: actions that arrive noisy, late or not at all."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from torchrl_osr.envs.disturbance import (
    DisturbanceWrapper,
    Step,
    Vector,
    bounded_box,
    check_count,
    check_strength,
    flag,
    gymnasium,
    vector_box,
)


class ActionNoise(DisturbanceWrapper):
    """Gaussian noise on every action, clipped to the action box.

    The random perturbation of "Robust Gymnasium" (https://arxiv.org/abs/2502.19652) on
    actions, in units of the box.

    Args:
        env: the environment, with bounded actions.
        std: standard deviation in units of the box's half-width; 0 is off, and leaves
            actions outside the box to the environment.

    Raises:
        ValueError: if ``std`` is negative or actions are unbounded.
        TypeError: if actions are not a Box.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import ActionNoise
        >>> env = ActionNoise(make_environment("Hopper-v5"), 0.05)
        >>> observation, _ = env.reset(seed=0)
        >>> bool(env.step(env.action_space.high)[-1]["disturbed"])
        True
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], std: float) -> None:
        check_strength("std", std)
        super().__init__(env, always=std > 0)
        self.std = std
        box = bounded_box(env.action_space)
        self._low, self._high, self._dtype = box.low, box.high, box.dtype
        low, high = box.low.astype(np.float64), box.high.astype(np.float64)
        self._scale = std * (high - low) / 2

    def step(self, action: Vector) -> Step:
        if self.std > 0:
            noise = self._scale * self._generator.standard_normal(self._scale.shape)
            noisy = (action + noise).astype(self._dtype)
            # np.clip is three times slower on a few numbers.
            action = np.minimum(np.maximum(noisy, self._low), self._high)
        return super().step(action)


class ActionDelay(DisturbanceWrapper):
    """Delay of every action by some steps; zeros until the first one arrives.

    Constant delays of "Reinforcement Learning with Random Delays"
    (https://arxiv.org/abs/2010.02966).

    Args:
        env: the environment, with real actions.
        steps: of the delay; 0 is off.

    Raises:
        ValueError: if ``steps`` is negative or no integer.
        TypeError: if actions are not a Box.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import ActionDelay
        >>> env = ActionDelay(make_environment("Hopper-v5"), 2)
        >>> observation, _ = env.reset(seed=0)
        >>> bool(env.step(env.action_space.high)[-1]["disturbed"])
        True
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], steps: int) -> None:
        check_count("steps", steps, 0)
        super().__init__(env, always=steps > 0)
        self.steps = steps
        box = vector_box(env.action_space, "actions")
        self._zero = np.zeros(box.shape, box.dtype)
        self._pending: deque[Vector] = deque()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        self._pending = deque([self._zero] * self.steps)
        return super().reset(seed=seed, options=options)

    def step(self, action: Vector) -> Step:
        if self.steps:
            # A copy: the caller may write the next action into the same array.
            self._pending.append(np.array(action))
            action = self._pending.popleft()
        return super().step(action)


class StickyAction(DisturbanceWrapper):
    """Repetition of the previous action, with some probability in each step.

    From "Revisiting the Arcade Learning Environment" (https://arxiv.org/abs/1709.06009),
    where it is 0.25. The previous action is the executed one, not the agent's; the
    first action of an episode is always the agent's.

    Args:
        env: the environment.
        probability: of a repetition, from 0 (off) to 1 (the first action forever).

    Raises:
        ValueError: if ``probability`` is not between 0 and 1.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import StickyAction
        >>> env = StickyAction(make_environment("Hopper-v5"), 1.0)
        >>> observation, _ = env.reset(seed=0)
        >>> [int(env.step(env.action_space.high)[-1]["disturbed"]) for _ in range(3)]
        [0, 1, 1]
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], probability: float) -> None:
        if not 0 <= probability <= 1:
            raise ValueError(
                f"probability must be between 0 and 1, got {probability!r}; 0 is off."
            )
        super().__init__(env)
        self.probability = probability
        self._previous: Vector | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        self._previous = None
        return super().reset(seed=seed, options=options)

    def step(self, action: Vector) -> Step:
        sticks = False
        if self.probability:
            if self._previous is not None:
                sticks = bool(self._generator.random() < self.probability)
            if not sticks:
                self._previous = np.array(action)
            assert self._previous is not None
            action = self._previous
        result = super().step(action)
        flag(result[-1], sticks)
        return result
