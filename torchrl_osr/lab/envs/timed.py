"""Knocks and pushes: disturbances that act for some steps, once an episode."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import gymnasium
import numpy as np

from torchrl_osr._checks import check_choice
from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Step,
    Vector,
    bounded_box,
    check_count,
    check_strength,
    flag,
    mujoco_task,
    vector_box,
)

At: TypeAlias = int | Literal["random"]
"""Steps of the agent before the disturbance; ``"random"`` averages over the gait."""

EARTH_GRAVITY = 9.81

SMALL = 1e-3
"""Magnitude of the benchmark's random actions, in units of the action."""


class TimedDisturbance(DisturbanceWrapper):
    """Abstract base that knows the moment; ``first`` is the earliest one allowed."""

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        *,
        at: At,
        window: tuple[int, int],
        first: int = 0,
    ) -> None:
        if at != "random":
            check_count("at, unless 'random',", at, first)
        start, end = window
        check_count("the start of window", start, first)
        check_count("the end of window", end, start + 1)
        super().__init__(env)
        self.at, self.window = at, (start, end)
        self._start = self._steps = 0

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(**options)
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


class ActionKnock(TimedDisturbance):
    r"""Random actions for some steps, once an episode.

    From "Recovering from Out-of-sample States via Inverse Dynamics in Offline
    Reinforcement Learning", section 5.2, https://openreview.net/forum?id=4gLWjSaw4o.

    * ``"official"``: the released sampler's (https://github.com/Jack10843/OSR,
      ``sampler.py``). After ``at`` steps of the agent, unless the episode has ended,
      the bare environment takes ``steps`` *extra* steps with actions
      :math:`U[0, 10^{-3})^A`; their rewards and ends are ignored. Sizes s, m, l: 5, 10,
      15.
    * ``"paper"``: actions :math:`N(0, 10^{-6} I)` take the place of the agent's for
      ``steps`` steps, which count like all others. Sizes s, m, l: 5, 10, 20.
    * ``"torque"``: every entry of the action is at its lower or upper bound, each with
      probability 1/2 and drawn anew in every step. The steps count as in ``"paper"``.
      Discrete actions are drawn uniformly.

    Actions as small as those of ``"official"`` make the robot limp, for ``steps`` times
    0.008 s (hopper, walker2d) or 0.05 s (halfcheetah). The knock is inside the agent's
    last step before it: that step returns the observation after the knock, with the
    reward, end and info of the agent's own action. A fall in the knock ends the episode
    only after the agent's next step, if the robot is not on its feet again. Extra steps
    act on ``env.unwrapped``: they do not count for the time limit and no wrapper sees
    them. Put this around the bare task, and observation noise around this.

    ``info["knock_steps"]`` is the number of knock steps in a step: ``steps`` in that
    one, 1 for each replaced action in the other modes, 0 elsewhere.

    Args:
        env: the environment, with real actions, or in ``"torque"`` mode discrete ones.
        steps: of the knock.

    Keyword Args:
        mode: ``"official"``, ``"paper"`` or ``"torque"``.
        at: steps of the agent before it, or ``"random"``. Default 500.
        window: ``"random"`` draws for each episode from ``window[0]`` to below
            ``window[1]``. Default ``(100, 600)``.

    Raises:
        ValueError: if ``mode`` is unknown, ``steps`` below 1, a moment negative (or 0
            in ``"official"`` mode), the window empty, or actions unbounded
            (``"torque"``).
        NotPossible: if actions are neither.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import ActionKnock
        >>> env = make_environment("HalfCheetah-v5")
        >>> env = ActionKnock(env, 15, mode="official", at=3)
        >>> observation, info = env.reset(seed=0)
        >>> infos = [env.step(env.action_space.low)[-1] for _ in range(5)]
        >>> [int(info["knock_steps"]) for info in infos]
        [0, 0, 15, 0, 0]
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        steps: int,
        *,
        mode: Literal["official", "paper", "torque"],
        at: At = 500,
        window: tuple[int, int] = (100, 600),
    ) -> None:
        check_choice("mode", mode, ("official", "paper", "torque"))
        check_count("steps", steps, 1)
        # The sampler knocks between two steps of the agent, never before the first.
        super().__init__(env, at=at, window=window, first=int(mode == "official"))
        self.steps, self.mode = steps, mode
        self._actions = env.action_space
        if mode != "torque":
            vector_box(self._actions, "actions")
        elif not isinstance(self._actions, gymnasium.spaces.Discrete):
            bounded_box(self._actions)

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(**options)
        info["knock_steps"] = np.int64(0)
        return observation, info

    def step(self, action: Vector) -> Step:
        number = self._count()
        if self.mode == "official":
            return self._then_knock(action, last=number == -1)
        knocked = 0 <= number < self.steps
        result = super().step(self._random_action() if knocked else action)
        flag(result[-1], knocked)["knock_steps"] = np.int64(knocked)
        return result

    def _then_knock(self, action: Vector, last: bool) -> Step:
        """Take the agent's step and, if it is the ``last`` before, the knock's."""
        observation, reward, terminated, truncated, info = super().step(action)
        knocked = last and not (terminated or truncated)
        if knocked:
            shape = self.unwrapped.action_space.shape
            for _ in range(self.steps):
                extra = self._generator.random(shape) * SMALL
                observation, *_ = self.unwrapped.step(extra)
            space = self.unwrapped.observation_space
            if not isinstance(space, gymnasium.spaces.Box):  # so does make_environment
                observation = np.asarray(gymnasium.spaces.flatten(space, observation))
        flag(info, knocked)["knock_steps"] = np.int64(self.steps * knocked)
        return observation, reward, terminated, truncated, info

    def _random_action(self) -> Vector:
        actions = self._actions
        if isinstance(actions, gymnasium.spaces.Discrete):
            return np.asarray(actions.start + self._generator.integers(actions.n))
        box = vector_box(actions, "actions")
        if self.mode == "paper":
            action = SMALL * self._generator.standard_normal(box.shape)
            return action.astype(box.dtype)
        upper = self._generator.random(box.shape) < 0.5
        return np.where(upper, box.high, box.low)


class ExternalPush(TimedDisturbance):
    """Push the torso forwards or backwards, once an episode.

    The arrow in the figures of the OSR paper, see :class:`ActionKnock`: a force along
    the world's x axis at the torso's centre of mass (MuJoCo's ``xfrc_applied``), for
    ``duration`` steps of the agent. A robot without a body ``torso`` is pushed at its
    heaviest. The sign is drawn for each episode. The agent acts
    on, rewards and survival count.

    ``info["push_force"]`` is the force of a step in newtons, with its sign.

    Args:
        env: one of Gymnasium's MuJoCo tasks.
        force: in ``unit``; 0 is off.

    Keyword Args:
        duration: in steps of the agent: 0.008 s each for hopper and walker2d, 0.05 s
            for halfcheetah.
        at, window: moment, as in :class:`ActionKnock`. Default ``"random"``.
        unit: ``"newton"`` (default) or ``"body_weight"``, the weight of all bodies when
            the model is wrapped, at 9.81 m/s² where the model has no gravity. Hopper
            weighs 155 N, walker2d 232 N, halfcheetah 137 N; forces in units of the
            weight accelerate robots alike.

    Raises:
        ValueError: if ``force`` is negative, ``duration`` below 1, the moment negative,
            the window empty, or ``unit`` unknown.
        NotPossible: if it is another environment.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import ExternalPush
        >>> env = ExternalPush(make_environment("Hopper-v5"), 50.0, duration=3, at=2)
        >>> observation, info = env.reset(seed=0)
        >>> forces = [env.step(env.action_space.high)[-1]["push_force"]
        ...           for _ in range(6)]
        >>> [float(abs(force)) for force in forces]
        [0.0, 0.0, 50.0, 50.0, 50.0, 0.0]
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        force: float,
        *,
        duration: int,
        at: At = "random",
        window: tuple[int, int] = (100, 600),
        unit: Literal["newton", "body_weight"] = "newton",
    ) -> None:
        check_strength("force", force)
        check_count("duration", duration, 1)
        check_choice("unit", unit, ("newton", "body_weight"))
        super().__init__(env, at=at, window=window)
        self._bare = mujoco_task(env, "ExternalPush")
        model = self._bare.model
        names = [model.body(number).name for number in range(model.nbody)]
        heaviest = int(model.body_mass.argmax())
        self._torso = names.index("torso") if "torso" in names else heaviest
        if unit == "body_weight":
            gravity = np.linalg.norm(model.opt.gravity) or EARTH_GRAVITY
            force *= model.body_mass.sum() * gravity
        self.force, self.duration = float(force), duration
        self._sign = 1.0

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(**options)
        self._sign = 1.0 if self._generator.random() < 0.5 else -1.0
        info["push_force"] = np.float64(0)
        return observation, info

    def step(self, action: Vector) -> Step:
        pushed = 0 <= self._count() < self.duration and self.force > 0
        force = self._sign * self.force if pushed else 0.0
        applied = self._bare.data.xfrc_applied[self._torso]
        before = applied[0]
        applied[0] = before + force
        result = super().step(action)
        # Restored, not subtracted: a rounding error would stay as a force.
        applied[0] = before
        flag(result[-1], pushed)["push_force"] = np.float64(force)
        return result
