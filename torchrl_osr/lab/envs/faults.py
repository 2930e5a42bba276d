"""Faulty actuators and sensors, other dynamics and start states."""

from __future__ import annotations

from collections import deque
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from torchrl_osr._checks import check_at_least, check_positive, check_weight
from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Env,
    Vector,
    box_of,
    flag,
    mujoco_task,
)


class ActionDelay(DisturbanceWrapper):
    """Delay every action by some steps; execute zeros until the first one arrives."""

    def __init__(self, env: Env, steps: int) -> None:
        check_at_least(0, "steps", steps)
        super().__init__(env, always=steps > 0)
        self.box = box_of(env.action_space, "actions")
        self.steps, self.pending = steps, deque[Vector]()

    def begin(self) -> None:
        self.pending = deque([np.zeros(self.box.shape, self.box.dtype)] * self.steps)

    def act(self, action: Vector) -> Vector:
        # A copy: the caller may write the next action into the same array.
        self.pending.append(np.array(action))
        return self.pending.popleft()


class ObservationNoise(DisturbanceWrapper):
    """Add Gaussian noise of ``std`` units to every observation, also the first.

    The ``unit`` is the data's standard deviation of each entry, ``[S]``, as in RORL
    (https://arxiv.org/abs/2206.02829), or 1 (default). Noisy observations may leave the
    observation space.
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


class DynamicsChange(DisturbanceWrapper):
    """Multiply masses, friction and gravity of the environment's model by factors.

    A factor of mass is also that of the moments of inertia; MuJoCo's armature and the
    motors' strength stay. The floor's friction changes, too.
    """

    def __init__(
        self, env: Env, *, mass: float = 1, friction: float = 1, gravity: float = 1
    ) -> None:
        check_positive("mass", mass)
        super().__init__(env, always=(mass, friction, gravity) != (1, 1, 1))
        model = mujoco_task(env).model
        model.body_mass *= mass
        model.body_inertia *= mass
        model.geom_friction *= friction
        model.pair_friction *= friction
        model.opt.gravity *= gravity
        if mass != 1:
            # Constants that MuJoCo derives from the masses, such as the softness of
            # contacts; with new data: the environment's may be in mid-episode.
            mujoco.mj_setConst(model, mujoco.MjData(model))


class StartStateNoise(DisturbanceWrapper):
    """Add Gaussian noise to the start state; put this around the bare task.

    ``std`` is in metres or radians, and in metres or radians a second. After strong
    noise an episode may start fallen, or with a foot in the ground.
    """

    def __init__(self, env: Env, std: float) -> None:
        check_weight("std", std)
        super().__init__(env)
        self.std = std
        self.bare = mujoco_task(env)

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(**options)
        if self.std == 0:
            return observation, info
        model, data = self.bare.model, self.bare.data
        position, velocity = self.std * self.generator.standard_normal((2, model.nv))
        qpos = np.array(data.qpos)
        mujoco.mj_integratePos(model, qpos, position, 1.0)
        # Calls mj_forward: everything that depends on the state is up to date.
        self.bare.set_state(qpos, data.qvel + velocity)
        info |= self.bare._get_reset_info()
        return self.bare._get_obs(), flag(info, True)
