"""Knocks and pushes: disturbances that act for some steps, once an episode."""

from __future__ import annotations

from typing import Literal, TypeAlias

import gymnasium
import numpy as np

from torchrl_osr._checks import check_choice, check_positive, check_weight
from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Env,
    Step,
    Vector,
    box_of,
    flag,
    mujoco_task,
)

EARTH_GRAVITY = 9.81
SMALL = 1e-3  # of the benchmark's random actions, in units of the action

At: TypeAlias = int | Literal["random"]
"""Steps of the agent before a disturbance; ``"random"`` averages over the gait."""


class TimedDisturbance(DisturbanceWrapper):
    """Base of the disturbances that act once an episode, at the earliest ``first``."""

    def __init__(
        self, env: Env, at: At, window: tuple[int, int], *, first: int = 0
    ) -> None:
        check_positive("the length of window", window[1] - window[0], minimum=1)
        earliest = window[0] if at == "random" else at
        check_positive("at, or the start of window,", earliest, minimum=first)
        super().__init__(env)
        self.at, self.window, self.next_step = at, window, 0

    def begin(self) -> None:
        drawn = self.at == "random"
        self.next_step = -int(
            self.generator.integers(*self.window) if drawn else self.at
        )

    def count(self) -> int:
        """Count a step; return its number, 0 at the disturbance, negative before."""
        self.next_step += 1
        return self.next_step - 1


class ActionKnock(TimedDisturbance):
    r"""Random actions for some steps, once an episode.

    From "Recovering from Out-of-sample States via Inverse Dynamics in Offline
    Reinforcement Learning", section 5.2, https://openreview.net/forum?id=4gLWjSaw4o.

    * ``"official"``: the released sampler (https://github.com/Jack10843/OSR,
      ``sampler.py``). After ``at`` steps of the agent, the bare environment takes
      ``steps`` *extra* steps with actions :math:`U[0, 10^{-3})^A`. Sizes s, m, l: 5,
      10, 15.
    * ``"paper"``: actions :math:`N(0, 10^{-6} I)` replace the agent's for ``steps``
      steps, which count like all others. Sizes s, m, l: 5, 10, 20.
    * ``"torque"``: as ``"paper"``, but each number of the action is at its lower or
      upper bound with probability 1/2. Discrete actions are drawn uniformly.

    The agent's last step before the official knock returns the observation after the
    knock, with the reward and end of the agent's own action; a fall in the knock ends
    the episode only after the agent's next step. Neither the time limit nor other
    wrappers see the extra steps. Put this around the bare task.

    Args:
        env: the environment, with real actions, or in ``"torque"`` mode discrete ones.
        steps: of the knock.

    Keyword Args:
        mode: ``"official"``, ``"paper"`` or ``"torque"``.
        at: steps of the agent before it (at least 1 in ``"official"`` mode), or
            ``"random"``. Default 500.
        window: ``"random"`` draws for each episode from ``window[0]`` to below
            ``window[1]``. Default ``(100, 600)``.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> env = make_environment("HalfCheetah-v5")
        >>> env = ActionKnock(env, 2, mode="paper", at=1)
        >>> _ = env.reset(seed=0)
        >>> infos = [env.step(env.action_space.low)[-1] for _ in range(4)]
        >>> [int(info["disturbed"]) for info in infos]
        [0, 1, 1, 0]
    """

    def __init__(
        self,
        env: Env,
        steps: int,
        *,
        mode: Literal["official", "paper", "torque"],
        at: At = 500,
        window: tuple[int, int] = (100, 600),
    ) -> None:
        check_choice("mode", mode, ("official", "paper", "torque"))
        check_positive("steps", steps, minimum=1)
        # The sampler knocks between two steps of the agent, never before the first.
        super().__init__(env, at, window, first=int(mode == "official"))
        self.steps, self.mode = steps, mode
        actions = env.action_space
        if mode != "torque" or not isinstance(actions, gymnasium.spaces.Discrete):
            actions = box_of(actions, "actions", bounded=mode == "torque")
        self.actions, self.due = actions, False

    def act(self, action: Vector) -> Vector:
        number = self.count()
        self.due = self.mode == "official" and number == -1
        self.acted = self.mode != "official" and 0 <= number < self.steps
        return self.random_action() if self.acted else action

    def step(self, action: Vector) -> Step:
        observation, reward, terminated, truncated, info = super().step(action)
        if self.due and not (terminated or truncated):
            bare = self.unwrapped
            for _ in range(self.steps):
                extra = self.generator.random(bare.action_space.shape) * SMALL
                observation, *_ = bare.step(extra)
            space = bare.observation_space
            if not isinstance(space, gymnasium.spaces.Box):  # so does make_environment
                observation = np.asarray(gymnasium.spaces.flatten(space, observation))
            flag(info, True)
        return observation, reward, terminated, truncated, info

    def random_action(self) -> Vector:
        """Draw an action that replaces the agent's."""
        actions = self.actions
        if isinstance(actions, gymnasium.spaces.Discrete):
            return np.asarray(actions.start + self.generator.integers(actions.n))
        if self.mode == "paper":
            action = SMALL * self.generator.standard_normal(actions.shape)
            return action.astype(actions.dtype)
        upper = self.generator.random(actions.shape) < 0.5
        return np.where(upper, actions.high, actions.low)


class ExternalPush(TimedDisturbance):
    """Push the torso forwards or backwards, once an episode.

    The arrow in the figures of the OSR paper, see :class:`ActionKnock`: a force along
    the world's x axis at the torso's centre of mass, or that of the heaviest body. The
    sign is drawn for each episode.

    Args:
        env: one of Gymnasium's MuJoCo tasks.
        force: in ``unit``; 0 is off.

    Keyword Args:
        duration: in steps of the agent: 0.008 s each for hopper and walker2d, 0.05 s
            for halfcheetah.
        at, window: moment, as in :class:`ActionKnock`. Default ``"random"``.
        unit: ``"newton"`` (default) or ``"body_weight"``, the weight of all bodies:
            155 N for hopper, 232 N for walker2d, 137 N for halfcheetah.
    """

    def __init__(
        self,
        env: Env,
        force: float,
        *,
        duration: int,
        at: At = "random",
        window: tuple[int, int] = (100, 600),
        unit: Literal["newton", "body_weight"] = "newton",
    ) -> None:
        check_weight("force", force)
        check_positive("duration", duration, minimum=1)
        check_choice("unit", unit, ("newton", "body_weight"))
        super().__init__(env, at, window)
        self.bare = mujoco_task(env)
        model = self.bare.model
        names = [model.body(number).name for number in range(model.nbody)]
        heaviest = int(model.body_mass.argmax())
        self.body = names.index("torso") if "torso" in names else heaviest
        if unit == "body_weight":
            gravity = np.linalg.norm(model.opt.gravity) or EARTH_GRAVITY
            force *= model.body_mass.sum() * gravity
        self.force, self.duration, self.sign = float(force), duration, 1.0

    def begin(self) -> None:
        super().begin()
        self.sign = 1.0 if self.generator.random() < 0.5 else -1.0

    def step(self, action: Vector) -> Step:
        pushed = 0 <= self.count() < self.duration and self.force > 0
        applied = self.bare.data.xfrc_applied[self.body]
        before = applied[0]
        applied[0] = before + pushed * self.sign * self.force
        result = super().step(action)
        # Restored, not subtracted: a rounding error would stay as a force.
        applied[0] = before
        flag(result[-1], pushed)
        return result
