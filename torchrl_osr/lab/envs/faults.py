"""Faults of actuators and sensors: noisy, late and repeated actions, noisy readings."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Step,
    Vector,
    bounded_box,
    check_count,
    check_strength,
    flag,
    vector_box,
)


class ActionNoise(DisturbanceWrapper):
    """Gaussian noise on every action, clipped to the action box.

    The random perturbation of "Robust Gymnasium" (https://arxiv.org/abs/2502.19652).

    Args:
        env: the environment, with bounded actions.
        std: standard deviation in half-widths of the box; 0 is off.

    Raises:
        ValueError: if ``std`` is negative or actions are unbounded.
        NotPossible: if actions are not a Box.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import ActionNoise
        >>> env = ActionNoise(make_environment("Hopper-v5"), 0.05)
        >>> _, info = env.reset(seed=0)
        >>> bool(info["disturbed"])
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
        NotPossible: if actions are not a Box.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import ActionDelay
        >>> env = ActionDelay(make_environment("Hopper-v5"), 2)
        >>> _, info = env.reset(seed=0)
        >>> bool(info["disturbed"])
        True
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], steps: int) -> None:
        check_count("steps", steps, 0)
        super().__init__(env, always=steps > 0)
        self.steps = steps
        box = vector_box(env.action_space, "actions")
        self._zero = np.zeros(box.shape, box.dtype)
        self._pending: deque[Vector] = deque()

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        self._pending = deque([self._zero] * self.steps)
        return super().reset(**options)

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
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import StickyAction
        >>> env = StickyAction(make_environment("Hopper-v5"), 1.0)
        >>> observation, _ = env.reset(seed=0)
        >>> [int(env.step(env.action_space.high)[-1]["disturbed"]) for _ in range(3)]
        [0, 1, 1]
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], probability: float) -> None:
        if not 0 <= probability <= 1:
            raise ValueError(f"probability must be in [0, 1], got {probability!r}.")
        super().__init__(env)
        self.probability = probability
        self._previous: Vector | None = None

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        self._previous = None
        return super().reset(**options)

    def step(self, action: Vector) -> Step:
        sticks = False
        if self._previous is not None and self.probability:
            sticks = bool(self._generator.random() < self.probability)
        if self._previous is None or not sticks:
            self._previous = np.array(action)
        result = super().step(self._previous)
        flag(result[-1], sticks)
        return result


class ObservationNoise(DisturbanceWrapper):
    """Gaussian noise on every observation; the simulated state is unchanged.

    The noise of "DMBP: Diffusion Model-Based Predictor for Robust Offline
    Reinforcement Learning against State Observation Perturbations" (ICLR 2024), which
    is absolute; with ``unit`` it is relative to the data, as in RORL,
    https://arxiv.org/abs/2206.02829. The first observation of an episode is noisy, too.
    Bounds of the observation space are not enforced.

    Args:
        env: the environment, with real observations.
        std: standard deviation, in ``unit``; 0 is off.

    Keyword Args:
        unit: the data's standard deviation in each dimension, in the shape of an
            observation. Default: 1, ``std`` is in the observation's own units.

    Raises:
        ValueError: if ``std`` or a number of ``unit`` is negative, or ``unit`` of
            another shape.
        NotPossible: if observations are not a Box.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import ObservationNoise
        >>> env = ObservationNoise(make_environment("Hopper-v5"), 0.1)
        >>> observation, _ = env.reset(seed=0)
        >>> clean, _ = make_environment("Hopper-v5").reset(seed=0)
        >>> bool((abs(observation - clean) > 0).all())
        True
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        std: float,
        *,
        unit: ArrayLike | None = None,
    ) -> None:
        check_strength("std", std)
        super().__init__(env, always=std > 0)
        shape = vector_box(env.observation_space, "observations").shape
        scale = np.ones(shape) if unit is None else np.asarray(unit, dtype=np.float64)
        if scale.shape != shape:
            raise ValueError(
                f"unit has shape {scale.shape}, but observations have {shape}; pass "
                "one standard deviation for each number of an observation."
            )
        if not (np.isfinite(scale) & (scale >= 0)).all():
            raise ValueError(f"unit must be finite and at least 0, got {scale}.")
        self.std = std
        self._scale = std * scale

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(**options)
        return self._seen(observation), info

    def step(self, action: Vector) -> Step:
        observation, *rest = super().step(action)
        return self._seen(observation), *rest

    def _seen(self, observation: Vector) -> Vector:
        if self.std == 0:
            return observation
        noise = self._generator.standard_normal(observation.shape)
        return (observation + self._scale * noise).astype(observation.dtype)
