"""Faulty actuators and sensors: noisy, late and repeated actions, noisy readings."""

from __future__ import annotations

from collections import deque

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from torchrl_osr._checks import check_positive, check_weight
from torchrl_osr.lab.envs.disturbance import DisturbanceWrapper, Env, Vector, box_of


class ActionNoise(DisturbanceWrapper):
    """Add Gaussian noise to every action and clip it to the action box.

    The random perturbation of "Robust Gymnasium" (https://arxiv.org/abs/2502.19652).
    The standard deviation ``std`` is in half-widths of the box.
    """

    def __init__(self, env: Env, std: float) -> None:
        check_weight("std", std)
        super().__init__(env, always=std > 0)
        self.box = box_of(env.action_space, "actions", bounded=True)
        low, high = (each.astype(np.float64) for each in (self.box.low, self.box.high))
        self.scale = std * (high - low) / 2

    def act(self, action: Vector) -> Vector:
        if not self.always:
            return action
        noise = self.scale * self.generator.standard_normal(self.scale.shape)
        noisy = (action + noise).astype(self.box.dtype)
        # np.clip is three times slower on a few numbers.
        return np.minimum(np.maximum(noisy, self.box.low), self.box.high)


class ActionDelay(DisturbanceWrapper):
    """Delay every action by some steps; execute zeros until the first one arrives.

    Constant delays of "Reinforcement Learning with Random Delays"
    (https://arxiv.org/abs/2010.02966).
    """

    def __init__(self, env: Env, steps: int) -> None:
        check_positive("steps", steps, minimum=0)
        super().__init__(env, always=steps > 0)
        self.box = box_of(env.action_space, "actions")
        self.steps, self.pending = steps, deque[Vector]()

    def begin(self) -> None:
        self.pending = deque([np.zeros(self.box.shape, self.box.dtype)] * self.steps)

    def act(self, action: Vector) -> Vector:
        # A copy: the caller may write the next action into the same array.
        self.pending.append(np.array(action))
        return self.pending.popleft()


class StickyAction(DisturbanceWrapper):
    """Execute the previous action once more, with some probability in each step.

    :class:`gymnasium.wrappers.StickyAction` with a random stream of its own, from
    "Revisiting the Arcade Learning Environment" (https://arxiv.org/abs/1709.06009),
    where the probability is 0.25.
    """

    def __init__(self, env: Env, probability: float) -> None:
        super().__init__(env)
        # Around an empty environment, whose random stream becomes that of the wrapper.
        self.sticky = gymnasium.wrappers.StickyAction(gymnasium.Env(), probability)

    def begin(self) -> None:
        self.sticky.np_random = self.generator
        self.sticky.last_action = None

    def act(self, action: Vector) -> Vector:
        previous = self.sticky.last_action
        # A copy: the caller may write the next action into the same array.
        executed: Vector = self.sticky.action(np.array(action))
        self.acted = executed is previous
        return executed


class ObservationNoise(DisturbanceWrapper):
    """Add Gaussian noise to every observation; the simulated state is unchanged.

    Absolute noise is that of DMBP (Yang and Xu, ICLR 2024), noise relative to the data
    that of RORL, https://arxiv.org/abs/2206.02829. The first observation of an episode
    is noisy, too. Noisy observations may leave the observation space.

    Args:
        env: the environment, with real observations.
        std: standard deviation, in ``unit``.

    Keyword Args:
        unit: the data's standard deviation of each entry of an observation, ``[S]``.
            Default: 1, so that ``std`` is in the observation's own units.
    """

    def __init__(self, env: Env, std: float, *, unit: ArrayLike = 1.0) -> None:
        check_weight("std", std)
        super().__init__(env, always=std > 0)
        shape = box_of(env.observation_space, "observations").shape
        self.scale = std * np.broadcast_to(np.asarray(unit, np.float64), shape)

    def observe(self, observation: Vector) -> Vector:
        if not self.always:
            return observation
        noise = self.generator.standard_normal(observation.shape)
        return (observation + self.scale * noise).astype(observation.dtype)
