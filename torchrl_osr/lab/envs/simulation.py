"""Changes of the simulation itself: other dynamics, other start states."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np

from torchrl_osr._checks import check_positive, check_weight
from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Env,
    Vector,
    flag,
    mujoco_task,
)


class DynamicsChange(DisturbanceWrapper):
    """Multiply masses, friction and gravity by constant factors.

    The changes of SCPO (https://arxiv.org/abs/2112.10513: mass and friction) and ODRL
    (https://arxiv.org/abs/2410.20750: friction and gravity times 0.1, 0.5, 2 and 5).
    The environment has a changed copy of its model until :meth:`close`.

    Keyword Args:
        mass: factor of all masses and moments of inertia; MuJoCo's armature and the
            motors' strength stay. Default 1.
        friction: factor of all friction coefficients of robot and ground. Default 1.
        gravity: factor of gravity. Default 1.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> env = DynamicsChange(make_environment("Hopper-v5"), gravity=0.5)
        >>> float(env.unwrapped.model.opt.gravity[2])
        -4.905
    """

    def __init__(
        self,
        env: Env,
        *,
        mass: float = 1.0,
        friction: float = 1.0,
        gravity: float = 1.0,
    ) -> None:
        check_positive("mass", mass)
        check_weight("friction", friction)
        check_weight("gravity", gravity)
        super().__init__(env, always=(mass, friction, gravity) != (1, 1, 1))
        self.bare = mujoco_task(env)
        self.original = self.bare.model
        if not self.always:
            return
        model = copy.deepcopy(self.original)
        model.body_mass *= mass
        model.body_inertia *= mass
        model.geom_friction *= friction
        model.pair_friction *= friction
        model.opt.gravity *= gravity
        if mass != 1:
            # Constants that MuJoCo derives from the masses, such as the softness of
            # contacts; with new data: the environment's may be in mid-episode.
            mujoco.mj_setConst(model, mujoco.MjData(model))
        self.bare.model = model

    def close(self) -> None:
        """Restore the environment's own model and close it."""
        self.bare.model = self.original
        super().close()


class StartStateNoise(DisturbanceWrapper):
    """Add Gaussian noise to the start state of an episode.

    The standard deviation ``std`` is that of each degree of freedom, in metres or
    radians, and in metres or radians a second. After strong noise an episode may start
    fallen, or with a foot in the ground. Put this around the bare task.
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
