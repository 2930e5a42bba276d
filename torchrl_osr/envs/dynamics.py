"""Changed dynamics: masses, friction and gravity times a factor."""

from __future__ import annotations

import copy
import math

from torchrl_osr.envs.disturbance import (
    DisturbanceWrapper,
    Vector,
    gymnasium,
    mujoco,
    owns_simulation,
)


class DynamicsChange(DisturbanceWrapper):
    """Masses, friction and gravity times constant factors.

    The changes of SCPO (https://arxiv.org/abs/2112.10513: mass and friction over grids
    of factors) and of ODRL (https://arxiv.org/abs/2410.20750: friction and gravity
    times 0.1, 0.5, 2 and 5).

    The environment has a changed copy of its model until :meth:`close`, which restores
    its own: factors never accumulate. A factor of 1 changes nothing.

    Args:
        env: a MuJoCo environment.

    Keyword Args:
        mass: factor of all masses and moments of inertia; the motors' own (MuJoCo's
            armature) and their strength stay. Default 1.
        friction: factor of all friction coefficients, sliding, torsional and rolling,
            of robot and ground alike. Default 1.
        gravity: factor of gravity. Default 1.

    Raises:
        ValueError: if a factor is negative or infinite, or ``mass`` is 0.
        TypeError: if it is none of Gymnasium's own MuJoCo tasks.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import DynamicsChange
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
            if not 0 <= factor < math.inf or (name == "mass" and factor == 0):
                least = "above 0" if name == "mass" else "at least 0"
                raise ValueError(
                    f"{name} must be finite, {least}, got {factor!r}; 1 is off."
                )
        changed = any(factor != 1 for factor in factors.values())
        super().__init__(env, always=changed)
        self.mass, self.friction, self.gravity = mass, friction, gravity
        self._bare = owns_simulation(env, "DynamicsChange")
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
