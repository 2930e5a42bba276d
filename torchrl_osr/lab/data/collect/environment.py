"""The Gymnasium tasks that data are collected on and policies are played on.

Those of gymnasium-robotics too (``torchrl-osr[mazes]``), which are registered when one
is asked for.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stderr
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from torchrl_osr._extras import needed_by
from torchrl_osr.lab.data.collect.behavior import load_behavior_card

with needed_by("MuJoCo tasks need", "train"):
    import gymnasium
    import mujoco
    from gymnasium import spaces

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

MAX_EPISODE = 100_000
"""Steps of an episode, at most; one that never ends would be waited for in vain."""


def environment_id(env_name: str) -> str:
    """Gymnasium id of a maze, or of a task with behaviour policies, by short name."""
    if env_name in MAZE_IDS:
        return MAZE_IDS[env_name]
    card = load_behavior_card()
    if env_name not in card:
        names = ", ".join([*sorted(card), *MAZE_IDS])
        raise ValueError(f"unknown environment {env_name!r}; there are: {names}.")
    return str(card[env_name]["env"])


def environment_name(env_id: str) -> str:
    """Short name of a task, which its behaviour policies and reference returns have.

    Of a task without them it is the id, without the module that registers it and with
    ``-`` for what has no place in a folder's name.

    Examples:
        >>> from torchrl_osr.lab.data.collect.environment import environment_name
        >>> environment_name("Hopper-v5"), environment_name("robots:ns/Arm-v0")
        ('hopper', 'ns-Arm-v0')
    """
    known = {entry["env"]: name for name, entry in load_behavior_card().items()}
    known |= {maze: name for name, maze in MAZE_IDS.items()}
    return str(known.get(env_id) or re.sub(r"[^\w.-]", "-", env_id.split(":")[-1]))


class EnvironmentSpec(NamedTuple):
    """What data and networks of a task must fit, in plain numbers.

    Attributes:
        observation_size: numbers of an observation, ``S``.
        action_size: numbers of an action, or the number of discrete actions, ``A``.
        action_low: lowest action in the task's own units, ``A`` numbers; ``None`` if
            actions are discrete.
        action_high: highest action, likewise.
        simulated: whether it can be played: one without ``step`` says what a machine
            observes and does, and no more.
    """

    observation_size: int
    action_size: int
    action_low: list[float] | None
    action_high: list[float] | None
    simulated: bool

    @property
    def discrete(self) -> bool:
        """Whether an action is one of ``A``, not ``A`` numbers."""
        return self.action_low is None


def environment_spec(env_id: str) -> EnvironmentSpec:
    """Sizes and action bounds of a task, see :func:`open_environment`.

    Examples:
        >>> from torchrl_osr.lab.data import environment_spec
        >>> environment_spec("Pendulum-v1")
        EnvironmentSpec(observation_size=3, action_size=1, action_low=[-2.0], action_high=[2.0], simulated=True)
    """  # noqa: E501
    with closing(open_environment(env_id)) as env:
        (observation_size,) = env.observation_space.shape or (0,)
        actions = env.action_space
        if isinstance(actions, spaces.Discrete):
            size, low, high = int(actions.n), None, None
        else:
            assert isinstance(actions, spaces.Box)
            low, high = actions.low.tolist(), actions.high.tolist()
            size = len(low)
        return EnvironmentSpec(observation_size, size, low, high, is_simulated(env))


def is_simulated(env: gymnasium.Env[Any, Any]) -> bool:
    """Whether an environment can be played, see :class:`EnvironmentSpec`."""
    return type(env.unwrapped).step is not gymnasium.Env.step


def check_simulated(env: gymnasium.Env[Any, Any], env_id: str) -> None:
    """Raise a RuntimeError unless an environment can be played."""
    if not is_simulated(env):
        raise RuntimeError(
            f"{env_id} has no simulator (its class has no step), so that nothing can "
            "be played in it: train and export do without."
        )


def make_environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium task with the actions that the losses and the data have.

    Real actions are rescaled to -1 and 1, unless these are their bounds already, as
    those of hopper, walker2d and halfcheetah. Discrete ones are numbered from 0.

    Args:
        env_id: see :func:`open_environment`, as for what is raised.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> make_environment("HalfCheetah-v5").action_space.shape
        (6,)
    """
    env = open_environment(env_id)
    actions = env.action_space
    if isinstance(actions, spaces.Discrete):
        return env
    assert isinstance(actions, spaces.Box)
    if np.any(actions.low != -1) or np.any(actions.high != 1):
        env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    return env


def open_environment(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium task with actions in its own units.

    Observations that are dictionaries or tuples become one vector, keys in alphabetical
    order (:class:`gymnasium.wrappers.FlattenObservation`), as
    :func:`~torchrl_osr.lab.data.load_minari` has them: of a maze ``achieved_goal``,
    ``desired_goal``, ``observation``. Mazes end (``terminated``) at their goal.
    Discrete actions are numbered from 0.

    Args:
        env_id: Gymnasium id, such as ``"Hopper-v5"``, or ``"my_package:MyRobot-v0"``,
            which imports ``my_package`` first.

    Raises:
        ValueError: there is no such task, its observations are no real vectors, or its
            actions neither real vectors with finite bounds nor discrete.
        ImportError: a package that the task needs is not installed, naming it.
        RuntimeError: in a step, if the task has no time limit and the episode has more
            than 100,000 steps.

    Examples:
        >>> from torchrl_osr.lab.data.collect.environment import open_environment
        >>> open_environment("Pendulum-v1").action_space
        Box(-2.0, 2.0, (1,), float32)
    """
    env = _found(env_id)
    if isinstance(env.observation_space, (spaces.Dict, spaces.Tuple)):
        env = gymnasium.wrappers.FlattenObservation(env)
    if not _is_real_vector(env.observation_space):
        raise ValueError(
            f"{env_id} has observations {env.observation_space}; expected a vector of "
            "real numbers, or a Dict or Tuple of such: make one in a wrapper, and "
            "register the wrapped environment."
        )
    actions = env.action_space
    if isinstance(actions, spaces.Discrete):
        if first := int(actions.start):
            env = gymnasium.wrappers.TransformAction(
                env, lambda action: action + first, spaces.Discrete(int(actions.n))
            )
    elif not _is_real_vector(actions):
        raise ValueError(
            f"{env_id} has actions {actions}; expected a vector of real numbers or "
            "Discrete: make one in a wrapper, and register the wrapped environment."
        )
    elif not actions.is_bounded():
        raise ValueError(
            f"{env_id} has actions {actions}; expected finite bounds, which policies "
            "are squashed to: wrap it in gymnasium.wrappers.ClipAction with a Box of "
            "the bounds that the machine has, and register the wrapped environment."
        )
    if env.spec is None or env.spec.max_episode_steps is None:
        env = _Ending(env)
    return env


class _Ending(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment without a time limit, which may or may not end by itself."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._steps = 0

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self._steps = 0
        return super().reset(**options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._steps += 1
        if self._steps > MAX_EPISODE:
            raise RuntimeError(
                f"an episode of {self.env} has not ended after {MAX_EPISODE:,} steps: "
                "register the environment with max_episode_steps."
            )
        return super().step(action)


def _is_real_vector(space: gymnasium.Space[Any]) -> TypeGuard[spaces.Box]:
    return (
        isinstance(space, spaces.Box)
        and len(space.shape) == 1
        and np.issubdtype(space.dtype, np.floating)
    )


def _found(env_id: str) -> gymnasium.Env[Any, Any]:
    """Make the task as it is registered; errors are those of our callers."""
    try:
        try:
            return _make(env_id)
        except gymnasium.error.NameNotFound as error:
            _register_robotics(env_id, error)
            return _make(env_id)
    except gymnasium.error.DependencyNotInstalled as error:
        needs = " ".join(map(str, error.args))
        raise ImportError(f"{env_id} needs another package: {needs}") from error
    except gymnasium.error.Error as error:
        raise ValueError(
            f"env.id={env_id} is no environment that Gymnasium knows: {error} An "
            "environment of a package of your own is env.id=<package>:<name>."
        ) from error
    except ModuleNotFoundError as error:
        if ":" not in env_id:
            raise
        raise ImportError(
            f"env.id={env_id} imports {env_id.partition(':')[0]!r} first, and that "
            f"failed: {error.__cause__ or error}. Install the package, or run the "
            "command in the folder that it is in."
        ) from error


def _make(env_id: str) -> gymnasium.Env[Any, Any]:
    if env_id.count(":") > 1:
        raise ValueError(f"env.id={env_id} has two colons; expected <package>:<name>.")
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
