"""What disturbances have in common: random stream, flag, checked arguments."""

from __future__ import annotations

import math
import zlib
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[Any]
"""An observation ``[S]`` or an action ``[A]``."""

Step: TypeAlias = tuple[Vector, Any, bool, bool, dict[str, Any]]
"""What ``step`` returns: observation, reward, terminated, truncated, info."""


class NotPossible(TypeError):
    """A disturbance needs what the environment lacks: MuJoCo, or real actions."""


def check_strength(name: str, value: float) -> None:
    """Raise a ValueError unless ``value`` is finite and at least 0."""
    if not 0 <= value < math.inf:
        raise ValueError(f"{name} must be a finite number, at least 0, got {value!r}.")


def check_count(name: str, value: object, least: int) -> None:
    """Raise a ValueError unless ``value`` is an integer of at least ``least``."""
    integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not integer or value < least:  # type: ignore[operator]
        raise ValueError(f"{name} must be an integer, at least {least}; got {value!r}.")


def vector_box(space: gymnasium.Space[Any], name: str) -> gymnasium.spaces.Box:
    """The space itself; raise NotPossible unless it is a Box."""
    if not isinstance(space, gymnasium.spaces.Box):
        raise NotPossible(f"The {name} are {space}; expected a Box of real numbers.")
    return space


def bounded_box(space: gymnasium.Space[Any]) -> gymnasium.spaces.Box:
    """The action space itself; raise unless it is a Box with finite bounds."""
    box = vector_box(space, "actions")
    if not box.is_bounded():
        raise ValueError(
            f"The actions are {box}; expected finite bounds, in whose units the "
            "disturbance is: wrap the environment in "
            "gymnasium.wrappers.RescaleAction or ClipAction first."
        )
    return box


def mujoco_task(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """The bare environment; raise NotPossible unless it is Gymnasium's own MuJoCo task.

    Others, such as the mazes, have their simulation in another environment inside them.
    """
    if not isinstance(env.unwrapped, MujocoEnv):
        raise NotPossible(
            f"{name} acts on the simulation of Gymnasium's own MuJoCo tasks, "
            f"'Hopper-v5' for instance; got {env.unwrapped}."
        )
    return env.unwrapped


def flag(info: dict[str, Any], disturbed: bool) -> dict[str, Any]:
    """Set ``info["disturbed"]``: whether this disturbance, or one inside it, acted."""
    # A NumPy scalar, like all numbers that wrappers put into info: TorchRL reads no
    # Python bool.
    info["disturbed"] = np.bool_(disturbed or info.get("disturbed", False))
    return info


class DisturbanceWrapper(gymnasium.Wrapper[Vector, Vector, Vector, Vector]):
    """Abstract base of the wrappers of this package.

    The episode's seed also seeds the wrapper's own generator, together with the name of
    its class and the number of wrappers of that class inside it: the environment draws
    what it would draw without the wrapper. A reset without a seed continues the
    generator.

    Args:
        env: the environment.
        always: whether it acts in every step and at the reset. Default ``False``.
    """

    def __init__(
        self, env: gymnasium.Env[Vector, Vector], *, always: bool = False
    ) -> None:
        super().__init__(env)
        self._always = always
        self._generator = np.random.default_rng()
        inside = 0
        while isinstance(env, gymnasium.Wrapper):
            inside += type(env) is type(self)
            env = env.env
        self._tag = (zlib.crc32(type(self).__name__.encode()), inside)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        if seed is not None:
            sequence = np.random.SeedSequence([seed, *self._tag])
            self._generator = np.random.default_rng(sequence)
        return observation, flag(info, self._always)

    def step(self, action: Vector) -> Step:
        result = self.env.step(action)
        flag(result[-1], self._always)
        return result
