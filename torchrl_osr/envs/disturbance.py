"""What disturbances have in common: random stream, flag, moment, checked arguments."""

from __future__ import annotations

import math
import zlib
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

try:
    import gymnasium as gymnasium
    import mujoco as mujoco
    from gymnasium.envs.mujoco import MujocoEnv
except ImportError as error:
    raise ImportError(
        f"disturbances need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

Vector: TypeAlias = NDArray[Any]
"""An observation ``[S]`` or an action ``[A]``."""

Step: TypeAlias = tuple[Vector, Any, bool, bool, dict[str, Any]]
"""What ``step`` returns: observation, reward, terminated, truncated, info."""

At: TypeAlias = int | Literal["random"]
"""Steps of the agent before the disturbance, or a moment drawn for each episode."""


def check_strength(name: str, value: float) -> None:
    """Raise a ValueError unless ``value`` is finite and at least 0."""
    if not 0 <= value < math.inf:
        raise ValueError(
            f"{name} must be a finite number, at least 0, got {value!r}; 0 is off."
        )


def check_count(name: str, value: object, least: int, *, or_else: str = "") -> None:
    """Raise a ValueError unless ``value`` is an integer of at least ``least``."""
    integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not integer or value < least:  # type: ignore[operator]
        alternative = f", or {or_else}" if or_else else ""
        raise ValueError(
            f"{name} must be an integer, at least {least}{alternative}; got {value!r}."
        )


def vector_box(space: gymnasium.Space[Any], name: str) -> gymnasium.spaces.Box:
    """Return ``space``, which must be a Box.

    Raises:
        TypeError: if it is another space.
    """
    if not isinstance(space, gymnasium.spaces.Box):
        raise TypeError(f"The {name} are {space}; expected a Box of real numbers.")
    return space


def bounded_box(space: gymnasium.Space[Any]) -> gymnasium.spaces.Box:
    """Return an action space, which must be a Box with finite bounds.

    Raises:
        TypeError: if it is another space.
        ValueError: if a bound is infinite.
    """
    box = vector_box(space, "actions")
    if not box.is_bounded():
        raise ValueError(
            f"The actions are {box}; expected finite bounds, in whose units the "
            "disturbance is: wrap the environment in "
            "gymnasium.wrappers.RescaleAction or ClipAction first."
        )
    return box


def simulated(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """Return the bare environment, which must simulate a MuJoCo model.

    Args:
        env: the environment, wrapped or not.
        name: of what asks, for the message.

    Raises:
        TypeError: if it has no ``model`` and ``data`` of MuJoCo's types.
    """
    bare = env.unwrapped
    model, data = getattr(bare, "model", None), getattr(bare, "data", None)
    if not isinstance(model, mujoco.MjModel) or not isinstance(data, mujoco.MjData):
        raise TypeError(
            f"{name} acts on a MuJoCo simulation, but {bare} has no model and data of "
            "types mujoco.MjModel and mujoco.MjData; use one of Gymnasium's MuJoCo "
            "tasks, 'Hopper-v5' for instance."
        )
    return bare


def owns_simulation(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """Return the bare environment, one of Gymnasium's own MuJoCo tasks.

    Args:
        env: the environment, wrapped or not.
        name: of what asks, for the message.

    Raises:
        TypeError: if there is no MuJoCo simulation, or it is another environment's, as
            in the mazes, whose state and model cannot be set from outside.
    """
    bare = simulated(env, name)
    if not isinstance(bare, MujocoEnv):
        raise TypeError(
            f"{name} sets state or model of a MuJoCo task, and those of {bare} belong "
            "to another environment inside it; use one of Gymnasium's own MuJoCo "
            "tasks, 'Hopper-v5' for instance."
        )
    return bare


def flag(info: dict[str, Any], disturbed: bool) -> dict[str, Any]:
    """Set ``info["disturbed"]``: whether this disturbance, or one inside it, acted."""
    # A NumPy scalar, like all numbers that wrappers put into info: TorchRL reads no
    # Python bool.
    info["disturbed"] = np.bool_(disturbed or info.get("disturbed", False))
    return info


class DisturbanceWrapper(gymnasium.Wrapper[Vector, Vector, Vector, Vector]):
    """Abstract base of the wrappers of this package.

    The episode's seed is passed on to the environment unchanged. It also seeds the
    wrapper's own generator, together with the name of its class and the number of
    wrappers of that class inside it: the environment draws what it would draw without
    the wrapper. A reset without a seed continues the generator.

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


class TimedDisturbance(DisturbanceWrapper):
    """Abstract base of the wrappers that act for some steps, once an episode.

    At a fixed moment all episodes are in much the same phase of the gait, and the
    result depends on that phase; ``"random"`` averages over it.

    Args:
        env: the environment.
        at: number of the agent's steps before it, or ``"random"``.
        window: first moment and the one after the last, for ``"random"``.
        first: the earliest moment allowed.
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        *,
        at: At,
        window: tuple[int, int],
        first: int = 0,
    ) -> None:
        if at != "random":
            check_count("at", at, first, or_else="the string 'random'")
        start, end = window
        check_count("the start of window", start, first)
        check_count("the end of window", end, start + 1)
        super().__init__(env)
        self.at, self.window = at, (start, end)
        self._start = self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        if self.at == "random":
            self._start = int(self._generator.integers(*self.window))
        else:
            self._start = self.at
        self._steps = 0
        return observation, info

    def _count(self) -> int:
        """Count a step of the agent; its number, 0 at the moment, negative before."""
        number = self._steps - self._start
        self._steps += 1
        return number
