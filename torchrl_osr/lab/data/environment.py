"""Gymnasium tasks, as data are collected on them and policies are played in them."""

from __future__ import annotations

import io
import re
import warnings
from contextlib import closing, redirect_stderr
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from torchrl_osr._checks import needed_by
from torchrl_osr.lab.data.behavior import load_behavior_card

# v4 of the ant, although there is v5: Minari's sets are of v4, whose observations lack
# the 78 contact forces of v5, as D4RL's do.
MAZE_IDS = {
    "pointmaze-umaze": "PointMaze_UMaze-v3",
    "pointmaze-medium": "PointMaze_Medium-v3",
    "pointmaze-large": "PointMaze_Large-v3",
    "antmaze-umaze": "AntMaze_UMaze_Test-v4",
    "antmaze-medium": "AntMaze_Medium_Test-v4",
    "antmaze-large": "AntMaze_Large_Test-v4",
}
"""Gymnasium ids of the mazes, by short name."""

Cell = tuple[int, int]
"""Row and column."""

TEST_CELLS: dict[str, tuple[Cell, Cell]] = {
    "umaze": ((1, 1), (3, 1)),
    "medium": ((1, 1), (6, 6)),
    "large": ((1, 1), (7, 9)),
}
"""Start and goal of D4RL's tests of the ant; gymnasium-robotics has no ids for them."""

MAX_EPISODE = 100_000
"""Time limit of tasks that have none, in steps."""


def known_ids() -> dict[str, str]:
    """Return Gymnasium ids of mazes and tasks with behaviour policies, by name."""
    return {name: str(e["env"]) for name, e in load_behavior_card().items()} | MAZE_IDS


def environment_name(env_id: str) -> str:
    """Return a known task's short name; for others their id as a folder's name.

    An ant with any start and goal has the name of its D4RL test.
    """
    names = {known.replace("_Test", ""): name for name, known in known_ids().items()}
    return names.get(env_id.replace("_Test", "")) or re.sub(
        r"[^\w.-]", "-", env_id.split(":")[-1]
    )


class EnvironmentSpec(NamedTuple):
    """Sizes and action bounds of a task; discrete actions have no bounds."""

    observation_size: int
    action_size: int
    action_low: list[float] | None
    action_high: list[float] | None

    @property
    def discrete(self) -> bool:
        """Whether an action is one of ``A``, not ``A`` numbers."""
        return self.action_low is None


def environment_spec(env_id: str) -> EnvironmentSpec:
    """Read sizes and action bounds of a task."""
    with closing(open_environment(env_id)) as env:
        size = spaces.flatdim(env.observation_space)
        actions: Any = env.action_space
        if isinstance(actions, spaces.Discrete):
            return EnvironmentSpec(size, int(actions.n), None, None)
        low, high = actions.low.tolist(), actions.high.tolist()
        return EnvironmentSpec(size, len(low), low, high)


def make_environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium task; continuous actions are rescaled to -1 and 1."""
    env = open_environment(env_id)
    actions: Any = env.action_space
    box = isinstance(actions, spaces.Box)
    if box and ((actions.low != -1) | (actions.high != 1)).any():
        env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    return env


def open_environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium task with actions in its own units.

    Observations that are dictionaries or tuples become one vector, in the order of
    :func:`sorted_space`. Mazes end (``terminated``) at their goal. The id
    ``"my_package:MyRobot-v0"`` imports ``my_package`` first.
    """
    env = _registered(env_id)
    if isinstance(env.observation_space, (spaces.Dict, spaces.Tuple)):
        parts = sorted_space(env.observation_space)
        flat: Any = spaces.flatten_space(parts)
        flat.entries = _entries(parts)
        flatten = partial(spaces.flatten, parts)
        env = gymnasium.wrappers.TransformObservation(env, flatten, flat)
    actions: Any = env.action_space
    bounded = _is_real_vector(actions) and actions.is_bounded()
    bounded = bounded and (actions.low < actions.high).all()
    numbered = isinstance(actions, spaces.Discrete) and actions.start == 0
    if not _is_real_vector(env.observation_space):
        flaw = f"observations {env.observation_space}; expected a real vector"
    elif not bounded and not numbered:
        flaw = (
            f"actions {actions}; expected real numbers, low < high, or Discrete from 0"
        )
    else:
        limited = env.spec is not None and env.spec.max_episode_steps is not None
        return env if limited else gymnasium.wrappers.TimeLimit(env, MAX_EPISODE)
    raise ValueError(f"{env_id} has {flaw}: register it with a wrapper that mends it.")


def sorted_space(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return an observation's space with the keys of dictionaries sorted.

    Environments, data and policies have this order.
    """
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: sorted_space(space[key]) for key in sorted(space)})
    if isinstance(space, spaces.Tuple):
        return spaces.Tuple([sorted_space(part) for part in space])
    image = space.dtype == np.uint8 and len(space.shape or ()) > 1
    if image or not space.is_np_flattenable:
        raise ValueError(f"an observation is {space}; expected real vectors.")
    return space


def _entries(space: Any, name: str = "") -> list[str]:
    """Return the names of the entries of a flattened observation."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        keys: Any = space if isinstance(space, spaces.Dict) else range(len(space))
        parts = [_entries(space[key], f"{name}.{key}") for key in keys]
        return [entry for part in parts for entry in part]
    return [f"{name[1:]}[{entry}]" for entry in range(spaces.flatdim(space))]


def _is_real_vector(space: gymnasium.Space[Any]) -> TypeGuard[spaces.Box]:
    vector = isinstance(space, spaces.Box) and len(space.shape) == 1
    return vector and np.issubdtype(space.dtype, np.floating)


def _registered(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make the task as it is registered, with clear errors."""

    def make() -> gymnasium.Env[Any, Any]:
        # Without a handler MuJoCo appends its notes on deprecated model attributes to
        # MUJOCO_LOG.TXT in the working folder. Warnings while stepping are left alone.
        handler = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda message: None)
        try:
            with warnings.catch_warnings():
                old_ant = r".*AntMaze_\w+-v4 is out of date"  # on purpose, see MAZE_IDS
                warnings.filterwarnings("ignore", old_ant, DeprecationWarning)
                return gymnasium.make(env_id)
        finally:
            mujoco.set_mju_user_warning(handler)

    try:
        try:
            env = make()
        except gymnasium.error.NameNotFound as error:
            what = f"Gymnasium has no {env_id!r} ({error}). A task of your own is "
            what += "env.id=<package>:<name>; a maze of gymnasium-robotics needs"
            # Importing it prints a note on hands to standard error.
            with needed_by(what, "mazes"), redirect_stderr(io.StringIO()):
                import gymnasium_robotics
            gymnasium.register_envs(gymnasium_robotics)
            if MAZE_IDS["antmaze-umaze"] not in gymnasium.registry:
                _register_ant_tests()
            env = make()
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        missing = gymnasium.error.DependencyNotInstalled, ModuleNotFoundError
        kind = ImportError if isinstance(error, missing) else ValueError
        why = str(error.__cause__ or error).rstrip(".")
        raise kind(
            f"env.id={env_id} cannot be made: {why}. A task of your own is "
            "env.id=<package>:<name>, where that can be imported."
        ) from error
    if env.spec is not None and "maze_map" in env.spec.kwargs:
        # Else an episode never ends at the goal, and the return is no success.
        env.set_wrapper_attr("continuing_task", False)
        # The model's file, which is loaded now and would be left for ever.
        Path(env.get_wrapper_attr("tmp_xml_file_path")).unlink(missing_ok=True)
    return env


def _register_ant_tests() -> None:
    for name, (start, goal) in TEST_CELLS.items():
        env_id = MAZE_IDS[f"antmaze-{name}"]
        spec = gymnasium.registry[env_id.replace("_Test", "")]
        maze = [list(row) for row in spec.kwargs["maze_map"]]
        maze[start[0]][start[1]], maze[goal[0]][goal[1]] = "r", "g"
        gymnasium.register(
            env_id,
            spec.entry_point,
            max_episode_steps=spec.max_episode_steps,
            kwargs=spec.kwargs | {"maze_map": maze},
        )
