"""Knocks and pushes: disturbances that act for some steps, once an episode."""

from __future__ import annotations

from typing import Literal, TypeAlias

import gymnasium
import numpy as np

from torchrl_osr._checks import check_at_least, check_choice, check_weight
from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Env,
    Step,
    Vector,
    box_of,
    flag,
    mujoco_task,
)

SMALL = 1e-3  # of the benchmark's random actions, in units of the action

At: TypeAlias = int | tuple[int, int]
"""Steps of the agent before a disturbance; of a range they are drawn each episode."""


class TimedDisturbance(DisturbanceWrapper):
    """Base of the disturbances that act once an episode, at the earliest ``first``."""

    def __init__(self, env: Env, at: At, first: int = 0) -> None:
        self.low, self.high = (at, at + 1) if isinstance(at, int) else at
        if not first <= self.low < self.high:
            raise ValueError(f"at must be >= {first}, or a range low < high, got {at}.")
        super().__init__(env)
        self.next_step = 0

    def begin(self) -> None:
        self.next_step = -int(self.generator.integers(self.low, self.high))

    def count(self) -> int:
        """Count a step; return its number, 0 at the disturbance, negative before."""
        self.next_step += 1
        return self.next_step - 1


class ActionKnock(TimedDisturbance):
    r"""Random actions for some steps, once an episode.

    From "Recovering from Out-of-sample States via Inverse Dynamics in Offline
    Reinforcement Learning", section 5.2, https://openreview.net/forum?id=4gLWjSaw4o.

    * ``"official"``: the released sampler (https://github.com/Jack10843/OSR,
      ``sampler.py``). After ``at`` steps of the agent, the environment takes ``steps``
      *extra* steps with actions :math:`U[0, 10^{-3})^A`. Sizes s, m, l: 5, 10, 15.
    * ``"paper"``: actions :math:`N(0, 10^{-6} I)` replace the agent's for ``steps``
      steps, which count like all others. Sizes s, m, l: 5, 10, 20.
    * ``"torque"``: as ``"paper"``, but each number of the action is at its lower or
      upper bound with probability 1/2. Discrete actions are drawn uniformly.

    The agent's last step before the official knock returns the observation after the
    knock, with the reward and end of the agent's own action. The time limit does not
    count the extra steps.

    Keyword Args:
        at: steps of the agent before it; of a range ``(low, high)``, a number from
            ``low`` to below ``high`` is drawn for each episode. Default 500.

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
    ) -> None:
        check_choice("mode", mode, ("official", "paper", "torque"))
        check_at_least(1, "steps", steps)
        # The sampler knocks between two steps of the agent, never before the first.
        super().__init__(env, at, first=int(mode == "official"))
        self.steps, self.mode = steps, mode
        actions = env.action_space
        if mode != "torque" or not isinstance(actions, gymnasium.spaces.Discrete):
            actions = box_of(actions, "actions")
        self.actions, self.due = actions, False

    def act(self, action: Vector) -> Vector:
        number = self.count()
        self.due = self.mode == "official" and number == -1
        self.acted = self.mode != "official" and 0 <= number < self.steps
        if not self.acted:
            return action
        actions = self.actions
        if isinstance(actions, gymnasium.spaces.Discrete):
            return np.asarray(actions.start + self.generator.integers(actions.n))
        if self.mode == "paper":
            action = SMALL * self.generator.standard_normal(actions.shape)
            return action.astype(actions.dtype)
        upper = self.generator.random(actions.shape) < 0.5
        return np.where(upper, actions.high, actions.low)

    def step(self, action: Vector) -> Step:
        observation, reward, terminated, truncated, info = super().step(action)
        if self.due and not (terminated or truncated):
            limited = self.has_wrapper_attr("_elapsed_steps")  # Gymnasium's TimeLimit
            elapsed = limited and self.get_wrapper_attr("_elapsed_steps")
            for _ in range(self.steps):
                extra = self.generator.random(self.actions.shape) * SMALL
                observation, *_ = self.env.step(extra)
            if limited:
                self.set_wrapper_attr("_elapsed_steps", elapsed)
            info = flag(info, True)
        return observation, reward, terminated, truncated, info


class ExternalPush(TimedDisturbance):
    """Push the torso, or the heaviest body, forwards or backwards, once an episode.

    The arrow in the figures of the OSR paper, see :class:`ActionKnock`: a force along
    the world's x axis, whose sign is drawn for each episode.

    Args:
        force: in body weights: 155 N for hopper, 232 N walker2d, 137 N halfcheetah.

    Keyword Args:
        duration: in steps of the agent: 0.008 s each for hopper and walker2d, 0.05 s
            for halfcheetah.
        at: moment, as in :class:`ActionKnock`. Default ``(100, 600)``.
    """

    def __init__(
        self, env: Env, force: float, *, duration: int, at: At = (100, 600)
    ) -> None:
        check_weight("force", force)
        check_at_least(1, "duration", duration)
        super().__init__(env, at)
        self.bare = mujoco_task(env)
        model = self.bare.model
        names = [model.body(number).name for number in range(model.nbody)]
        heaviest = int(model.body_mass.argmax())
        self.body = names.index("torso") if "torso" in names else heaviest
        weight = model.body_mass.sum() * np.linalg.norm(model.opt.gravity)
        self.force, self.duration, self.sign = force * weight, duration, 1.0

    def begin(self) -> None:
        super().begin()
        self.sign = 1.0 if self.generator.random() < 0.5 else -1.0

    def act(self, action: Vector) -> Vector:
        self.acted = 0 <= self.count() < self.duration and self.force > 0
        self.bare.data.xfrc_applied[self.body, 0] = self.acted * self.sign * self.force
        return action
