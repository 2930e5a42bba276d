"""Changes of the simulation itself: other dynamics, other start states."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import mujoco
import numpy as np

from torchrl_osr.lab.envs.disturbance import (
    DisturbanceWrapper,
    Vector,
    check_strength,
    flag,
    mujoco_task,
)


class DynamicsChange(DisturbanceWrapper):
    """Masses, friction and gravity times constant factors.

    The changes of SCPO (https://arxiv.org/abs/2112.10513: mass and friction over grids
    of factors) and of ODRL (https://arxiv.org/abs/2410.20750: friction and gravity
    times 0.1, 0.5, 2 and 5).

    The environment has a changed copy of its model until :meth:`close`, which restores
    its own: factors never accumulate. A factor of 1 changes nothing.

    Args:
        env: one of Gymnasium's MuJoCo tasks.

    Keyword Args:
        mass: factor of all masses and moments of inertia; the motors' own (MuJoCo's
            armature) and their strength stay. Default 1.
        friction: factor of all friction coefficients, sliding, torsional and rolling,
            of robot and ground alike. Default 1.
        gravity: factor of gravity. Default 1.

    Raises:
        ValueError: if a factor is negative or infinite, or ``mass`` is 0.
        NotPossible: if it is another environment.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import DynamicsChange
        >>> env = DynamicsChange(make_environment("Hopper-v5"), gravity=0.5)
        >>> float(env.unwrapped.model.opt.gravity[2])
        -4.905
        >>> env.close()
        >>> float(env.unwrapped.model.opt.gravity[2])
        -9.81
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        *,
        mass: float = 1.0,
        friction: float = 1.0,
        gravity: float = 1.0,
    ) -> None:
        factors = {"mass": mass, "friction": friction, "gravity": gravity}
        for name, factor in factors.items():
            check_strength(name, factor)
        if mass == 0:
            raise ValueError("mass must be above 0, got 0.")
        changed = any(factor != 1 for factor in factors.values())
        super().__init__(env, always=changed)
        self.mass, self.friction, self.gravity = mass, friction, gravity
        self._bare = mujoco_task(env, "DynamicsChange")
        self._original = self._bare.model
        if changed:
            self._bare.model = self._change(self._original)

    def _change(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """Changed copy of ``model``."""
        model = copy.deepcopy(model)
        model.body_mass *= self.mass
        model.body_inertia *= self.mass
        model.geom_friction *= self.friction
        model.pair_friction *= self.friction
        model.opt.gravity *= self.gravity
        if self.mass != 1:
            # Constants that MuJoCo derives from the masses, such as the softness of
            # contacts; with new data: the environment's may be in mid-episode.
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def close(self) -> None:
        """Restore the environment's own model and close it."""
        self._bare.model = self._original
        super().close()


class StartStateNoise(DisturbanceWrapper):
    """Gaussian noise on the start state of an episode.

    It is added to the environment's own noise (uniform, half-width 5e-3 for hopper and
    walker2d). Orientations of free bodies are rotated. After strong noise an episode
    may start fallen, or with a foot in the ground, which MuJoCo pushes out.

    Put this around the bare task, whose observation it returns, and observation noise
    around this.

    Args:
        env: one of Gymnasium's MuJoCo tasks.
        std: standard deviation in each degree of freedom, of positions in metres or
            radians, of velocities in metres or radians a second; 0 is off.

    Raises:
        ValueError: if ``std`` is negative.
        NotPossible: if it is another environment.

    Examples:
        >>> from torchrl_osr.lab.data import make_environment
        >>> from torchrl_osr.lab.envs import StartStateNoise
        >>> env = StartStateNoise(make_environment("Hopper-v5"), 0.05)
        >>> observation, info = env.reset(seed=0)
        >>> bool(info["disturbed"])
        True
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], std: float) -> None:
        check_strength("std", std)
        super().__init__(env)
        self.std = std
        self._bare = mujoco_task(env, "StartStateNoise")

    def reset(self, **options: Any) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(**options)
        if self.std == 0:
            return observation, info
        model, data = self._bare.model, self._bare.data
        position, velocity = self.std * self._generator.standard_normal((2, model.nv))
        qpos = np.array(data.qpos)
        mujoco.mj_integratePos(model, qpos, position, 1.0)
        # Calls mj_forward: everything that depends on the state is up to date.
        self._bare.set_state(qpos, data.qvel + velocity)
        info |= self._bare._get_reset_info()
        return self._bare._get_obs(), flag(info, True)
