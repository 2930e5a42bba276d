"""The Gymnasium tasks that data are collected on and policies are played on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchrl_osr.data.behavior import load_behavior_card

try:
    import gymnasium
    import mujoco
except ImportError as error:
    raise ImportError(
        f"MuJoCo tasks need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error


def environment_id(env_name: str) -> str:
    """Return the Gymnasium id of a short environment name.

    Raises:
        ValueError: there are no behaviour policies for that name.
    """
    card = load_behavior_card()
    if env_name not in card:
        raise ValueError(
            f"unknown environment {env_name!r}; there are: {', '.join(sorted(card))}."
        )
    return str(card[env_name]["env"])


def make_environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium task whose actions are bounded by -1 and 1.

    Tasks with other bounds are rescaled; hopper, walker2d and halfcheetah are not.

    Args:
        env_id: Gymnasium id, such as ``"Hopper-v5"``.

    Returns:
        The environment; MuJoCo's notes on deprecated model attributes do not end up
        in a ``MUJOCO_LOG.TXT`` in the working folder.

    Raises:
        ValueError: observations or actions are not real vectors.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> make_environment("HalfCheetah-v5").action_space.shape
        (6,)
    """
    with _silent_model_loading():
        env: gymnasium.Env[Any, Any] = gymnasium.make(env_id)
    for name, space in (
        ("observations", env.observation_space),
        ("actions", env.action_space),
    ):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"{env_id} has {name} {space}; expected a vector Box.")
    actions = env.action_space
    assert isinstance(actions, gymnasium.spaces.Box)
    if np.any(actions.low != -1) or np.any(actions.high != 1):
        env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    return env


@contextmanager
def _silent_model_loading() -> Iterator[None]:
    # Without a handler MuJoCo appends its notes on deprecated model attributes to
    # MUJOCO_LOG.TXT in the working folder. Warnings while stepping are left alone.
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)
