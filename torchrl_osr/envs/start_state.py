"""Start states outside of the data's: noise on joint positions and velocities."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_osr.envs.base import (
    DisturbanceWrapper,
    Vector,
    check_strength,
    flag,
    gymnasium,
    mujoco,
    owns_simulation,
)


class StartStateNoise(DisturbanceWrapper):
    """Add Gaussian noise to the state that an episode starts from.

    It comes on top of the environment's own (uniform, half-width 5e-3 for hopper and
    walker2d). Orientations of free bodies are turned, not added to. A strong noise may
    start an episode fallen or with a foot in the ground: MuJoCo pushes it out.

    Wrap it around the bare task: the observation is the task's own, and what changes
    observations belongs around this.

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
        # Ends in mj_forward, so that all that follows from the state is up to date.
        self._bare.set_state(qpos, data.qvel + velocity)
        info |= self._bare._get_reset_info()
        return self._bare._get_obs(), flag(info, True)
