"""The Gymnasium tasks that data are collected on and policies are played on.

Those of gymnasium-robotics too (``torchrl-osr[mazes]``), which are registered when one
is asked for.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_osr.data.collect.behavior import load_behavior_card

try:
    import gymnasium
    import mujoco
except ImportError as error:
    raise ImportError(
        f"MuJoCo tasks need {error.name!r}: pip install torchrl-osr[train]"
    ) from error

# v4 of the ant, although there is v5: Minari's sets are of v4, whose observations lack
# the 78 contact forces of v5, as D4RL's do.
MAZE_IDS = {
    "pointmaze-umaze": "PointMaze_UMaze-v3",
    "pointmaze-medium": "PointMaze_Medium-v3",
    "pointmaze-large": "PointMaze_Large-v3",
    "antmaze-umaze": "AntMaze_UMaze-v4",
    "antmaze-medium": "AntMaze_Medium-v4",
    "antmaze-large": "AntMaze_Large-v4",
}
"""Gymnasium ids of the mazes, by short environment name."""


def environment_id(env_name: str) -> str:
    """Gymnasium id of a maze, or of a task with behaviour policies, by short name."""
    if env_name in MAZE_IDS:
        return MAZE_IDS[env_name]
    card = load_behavior_card()
    if env_name not in card:
        names = ", ".join([*sorted(card), *MAZE_IDS])
        raise ValueError(f"unknown environment {env_name!r}; there are: {names}.")
    return str(card[env_name]["env"])


def make_environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium task whose actions are bounded by -1 and 1.

    Tasks with other bounds are rescaled; hopper, walker2d and halfcheetah are not.
    Observations that are dictionaries become one vector, keys in alphabetical order
    (:class:`gymnasium.wrappers.FlattenObservation`), as
    :func:`~torchrl_osr.data.load_minari` has them: of a maze ``achieved_goal``,
    ``desired_goal``, ``observation``. Mazes end (``terminated``) at their goal.

    Args:
        env_id: Gymnasium id, such as ``"Hopper-v5"``.

    Raises:
        ValueError: observations or actions are not real vectors.
        ImportError: Gymnasium alone has no such task, and there is no
            gymnasium-robotics.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> make_environment("HalfCheetah-v5").action_space.shape
        (6,)
    """
    try:
        env = _make(env_id)
    except gymnasium.error.NameNotFound as error:
        _register_robotics(env_id, error)
        env = _make(env_id)
    if isinstance(env.observation_space, gymnasium.spaces.Dict):
        env = gymnasium.wrappers.FlattenObservation(env)
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


def _make(env_id: str) -> gymnasium.Env[Any, Any]:
    spec = gymnasium.registry.get(env_id)
    # Without it an episode never ends at the goal, and the return is no success.
    options = {"continuing_task": False} if spec and "maze_map" in spec.kwargs else {}
    with _silent_model_loading(), warnings.catch_warnings():
        # On purpose, see MAZE_IDS.
        warnings.filterwarnings(
            "ignore", r".*AntMaze_\w+-v4 is out of date", DeprecationWarning
        )
        env: gymnasium.Env[Any, Any] = gymnasium.make(env_id, **options)
    if env_id in MAZE_IDS.values():
        # The model's file, which is loaded now and would be left for ever.
        Path(env.get_wrapper_attr("tmp_xml_file_path")).unlink(missing_ok=True)
    return env


def _register_robotics(env_id: str, unknown: Exception) -> None:
    try:
        # Importing it prints a note on hands that were changed, to standard error.
        with redirect_stderr(io.StringIO()):
            import gymnasium_robotics
    except ImportError as error:
        raise ImportError(
            f"Gymnasium itself has no {env_id!r} ({unknown}); those of "
            f"gymnasium-robotics need {error.name!r}: pip install torchrl-osr[mazes]"
        ) from error
    gymnasium.register_envs(gymnasium_robotics)


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
