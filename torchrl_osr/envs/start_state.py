"""Noise on start states: joint positions and velocities."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_osr.envs.disturbance import (
    DisturbanceWrapper,
    Vector,
    check_strength,
    flag,
    gymnasium,
    mujoco,
    owns_simulation,
)


class StartStateNoise(DisturbanceWrapper):
    """Gaussian noise on the start state of an episode.

    It is added to the environment's own noise (uniform, half-width 5e-3 for hopper and
    walker2d). Orientations of free bodies are rotated. After strong noise an episode
    may start fallen, or with a foot in the ground, which MuJoCo pushes out.

    Put this around the bare task, whose observation it returns, and observation noise
    around this.

    Args:
        env: a MuJoCo environment of Gymnasium.
        std: standard deviation in each degree of freedom, of positions in metres or
            radians, of velocities in metres or radians a second; 0 is off.

    Raises:
        ValueError: if ``std`` is negative.
        TypeError: if it is none of Gymnasium's own MuJoCo tasks.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import StartStateNoise
        >>> env = StartStateNoise(make_environment("Hopper-v5"), 0.05)
        >>> observation, info = env.reset(seed=0)
        >>> bool(info["disturbed"])
        True
    """

    def __init__(self, env: gymnasium.Env[Vector, Vector], std: float) -> None:
        check_strength("std", std)
        super().__init__(env)
        self.std = std
        self._bare = owns_simulation(env, "StartStateNoise")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
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
