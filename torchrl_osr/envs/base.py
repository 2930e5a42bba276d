"""What every disturbance does alike: its own random stream, its flag in ``info``."""

from __future__ import annotations

import zlib
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

try:
    import gymnasium as gymnasium
    import mujoco as mujoco
except ImportError as error:
    raise ImportError(
        f"disturbances need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

Vector: TypeAlias = NDArray[Any]
"""An observation ``[S]`` or an action ``[A]``."""

Step: TypeAlias = tuple[Vector, Any, bool, bool, dict[str, Any]]
"""What ``step`` returns: observation, reward, terminated, truncated, info."""


def flag(info: dict[str, Any], disturbed: bool) -> dict[str, Any]:
    """Say in ``info`` whether this disturbance, or one inside it, acted."""
    # A NumPy scalar, as all that wrappers write there: TorchRL reads no other.
    info["disturbed"] = np.bool_(disturbed or info.get("disturbed", False))
    return info


class Disturbance(gymnasium.Wrapper[Vector, Vector, Vector, Vector]):
    """Abstract base of the wrappers of this package.

    The episode's seed reaches the environment as it is, and a generator of the
    wrapper's own, which also depends on its class and on how many of the class are
    inside: what the environment draws is what it would draw without the wrapper.
    A reset without a seed continues the generator.

    Args:
        env: the environment.
        always: whether it acts in every step, and on the first observation. Default
            ``False``.
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
