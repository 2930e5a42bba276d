"""The knock of the OOSMuJoCo benchmarks: some steps of random actions."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from torchrl_osr._checks import check_choice
from torchrl_osr.envs.disturbance import (
    At,
    Step,
    TimedDisturbance,
    Vector,
    bounded_box,
    check_count,
    flag,
    gymnasium,
    vector_box,
)

SMALL = 1e-3
"""Magnitude of the benchmark's random actions, in units of the action."""


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

    Consequences of ``"official"``:

    * actions that small are none: the robot goes limp for ``steps`` times 0.008 s
      (hopper, walker2d) or 0.05 s (halfcheetah). Sizes are not comparable between
      robots, and the episode is longer by that time, without reward;
    * an episode that ends before ``at`` has no knock;
    * a fall during the knock ends the episode only after the agent's next step, which
      is rewarded, and not at all if that step puts the robot back on its feet;
    * extra steps act on ``env.unwrapped``, as the sampler's do. They do not count for
      the time limit, and no wrapper sees them. Put this around the bare task, and
      observation noise around this.

    In ``"official"`` mode the knock is inside the agent's last step before it: that
    step returns the observation after the knock, with the reward, end and info of the
    agent's own action. ``info["knock_steps"]`` is the number of knock steps in a step:
    ``steps`` in that one, 1 for each replaced action in the other modes, 0 elsewhere.

    Args:
        env: the environment, with real actions.
        steps: of the knock.

    Keyword Args:
        mode: ``"official"``, ``"paper"`` or ``"torque"``.
        at: steps of the agent before it. Default 500. ``"random"`` draws the number for
            each episode.
        window: ``"random"`` draws from ``window[0]`` to below ``window[1]``. Default
            ``(100, 600)``.

    Raises:
        ValueError: if ``mode`` is unknown, ``steps`` below 1, a moment negative (or 0
            in ``"official"`` mode), the window empty, or actions in ``"torque"`` mode
            are unbounded.
        TypeError: if actions are not a Box.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import ActionKnock
        >>> env = ActionKnock(make_environment("HalfCheetah-v5"), 15, mode="official")
        >>> observation, info = env.reset(seed=0)
        >>> action, knocks = env.action_space.low, []
        >>> for _ in range(1000):
        ...     *_, truncated, info = env.step(action)
        ...     knocks.append(int(info["knock_steps"]))
        >>> knocks[499], sum(knocks), truncated
        (15, 15, True)
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
        self._box = vector_box(env.action_space, "actions")
        if mode == "torque":
            bounded_box(self._box)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
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
            if isinstance(space, gymnasium.spaces.Dict):  # a vector in make_environment
                observation = gymnasium.spaces.flatten(space, observation)
        flag(info, knocked)["knock_steps"] = np.int64(self.steps * knocked)
        return observation, reward, terminated, truncated, info

    def _random_action(self) -> Vector:
        box = self._box
        if self.mode == "paper":
            action = SMALL * self._generator.standard_normal(box.shape)
            return action.astype(box.dtype)
        upper = self._generator.random(box.shape) < 0.5
        return np.where(upper, box.high, box.low)
