"""What the disturbances ask of their arguments and of the environment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

from torchrl_osr.envs.base import gymnasium, mujoco


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
