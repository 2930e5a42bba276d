"""Random stream, flag and checks that all disturbances share."""

from __future__ import annotations

import zlib
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[Any]
"""Observation ``[S]`` or action ``[A]``."""

Env: TypeAlias = gymnasium.Env[Vector, Vector]

Step: TypeAlias = tuple[Vector, Any, bool, bool, dict[str, Any]]
"""Observation, reward, terminated, truncated, info."""


class NotPossible(TypeError):
    """The environment lacks MuJoCo, or continuous actions, that a disturbance needs."""


def box_of(space: gymnasium.Space[Any], name: str) -> gymnasium.spaces.Box:
    """Return the space; raise NotPossible unless it is a Box."""
    if isinstance(space, gymnasium.spaces.Box):
        return space
    raise NotPossible(f"The {name} are {space}; expected a Box of real numbers.")


def mujoco_task(env: gymnasium.Env[Any, Any]) -> Any:
    """Return the bare environment; raise NotPossible unless it is a MuJoCo task."""
    if isinstance(env.unwrapped, MujocoEnv):
        return env.unwrapped
    raise NotPossible(
        "This disturbance acts on the simulation of Gymnasium's own MuJoCo tasks, "
        f"'Hopper-v5' for instance; got {env.unwrapped}."
    )


def flag(info: dict[str, Any], disturbed: bool) -> dict[str, Any]:
    """Return info with ``"disturbed"``: whether this one, or one inside it, acted."""
    # A NumPy scalar: TorchRL reads no Python bool from info.
    return info | {"disturbed": np.bool_(disturbed or info.get("disturbed", False))}


class DisturbanceWrapper(gymnasium.Wrapper[Vector, Vector, Vector, Vector]):
    """Base of the disturbances: override :meth:`begin`, :meth:`act` or :meth:`observe`.

    A reset with a seed also seeds :attr:`generator`, which differs by class. An
    ``always`` disturbance acts in every step and at the reset.
    """

    def __init__(self, env: Env, *, always: bool = False) -> None:
        super().__init__(env)
        self.always, self.acted = always, False
        self.generator = np.random.default_rng()

    def begin(self) -> None:
        """Draw what an episode needs."""

    def act(self, action: Vector) -> Vector:
        """Return the action to execute; set :attr:`acted` if it is another."""
        return action

    def observe(self, observation: Vector) -> Vector:
        """Return the observation that the agent gets."""
        return observation

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        if seed is not None:
            key = zlib.crc32(type(self).__name__.encode())
            self.generator = np.random.default_rng([seed, key])
        self.begin()
        return self.observe(observation), flag(info, self.always)

    def step(self, action: Vector) -> Step:
        self.acted = self.always
        action = self.act(action)
        observation, reward, terminated, truncated, info = super().step(action)
        info = flag(info, self.acted)
        return self.observe(observation), reward, terminated, truncated, info
