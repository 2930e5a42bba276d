"""A push: an external force on the robot's body for some steps."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from torchrl_osr._checks import check_choice
from torchrl_osr.envs.disturbance import (
    At,
    Step,
    TimedDisturbance,
    Vector,
    check_count,
    check_strength,
    flag,
    gymnasium,
    mujoco,
    simulated,
)


class ExternalPush(TimedDisturbance):
    """Push a body forwards or backwards, once an episode.

    The knock that the figures of "Recovering from Out-of-sample States via Inverse
    Dynamics in Offline Reinforcement Learning" draw as arrows, as a real force: along
    the world's x axis at the body's centre of mass (MuJoCo's ``xfrc_applied``),
    constant for ``duration`` steps of the agent. The sign is drawn for each episode.
    The agent acts on, rewards and survival count.

    ``info["push_force"]`` is the force of a step in newtons, with its sign.

    Args:
        env: a MuJoCo environment.
        force: in ``unit``; 0 is off.

    Keyword Args:
        duration: in steps of the agent: 0.008 s each for hopper and walker2d, 0.05 s
            for halfcheetah.
        at: steps of the agent before it. Default ``"random"``, drawn for each episode.
        window: ``"random"`` draws from ``window[0]`` to below ``window[1]``. Default
            ``(100, 600)``.
        unit: ``"newton"`` (default) or ``"body_weight"``, the weight of all bodies when
            the model is wrapped. Hopper weighs 155 N, walker2d 232 N, halfcheetah
            137 N; forces in units of the weight accelerate robots alike.
        body: name of the body. Default ``"torso"``.

    Raises:
        ValueError: if ``force`` is negative, ``duration`` below 1, the moment negative,
            the window empty, ``unit`` or ``body`` unknown.
        TypeError: if there is no MuJoCo model.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import ExternalPush
        >>> env = ExternalPush(make_environment("Hopper-v5"), 50.0, duration=3, at=2)
        >>> observation, info = env.reset(seed=0)
        >>> forces = [env.step(env.action_space.high)[-1]["push_force"]
        ...           for _ in range(6)]
        >>> [float(abs(force)) for force in forces]
        [0.0, 0.0, 50.0, 50.0, 50.0, 0.0]
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        force: float,
        *,
        duration: int,
        at: At = "random",
        window: tuple[int, int] = (100, 600),
        unit: Literal["newton", "body_weight"] = "newton",
        body: str = "torso",
    ) -> None:
        check_strength("force", force)
        check_count("duration", duration, 1)
        check_choice("unit", unit, ("newton", "body_weight"))
        super().__init__(env, at=at, window=window)
        self._bare = simulated(env, "ExternalPush")
        model = self._bare.model
        names = [model.body(index).name for index in range(1, model.nbody)]
        if body not in names:
            raise ValueError(f"body must be one of {names}, got {body!r}.")
        self._body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
        if unit == "body_weight":
            weight = model.body_mass.sum() * np.linalg.norm(model.opt.gravity)
            force = float(force * weight)
        self.force, self.duration = float(force), duration
        self._sign = 1.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        self._sign = 1.0 if self._generator.random() < 0.5 else -1.0
        info["push_force"] = np.float64(0)
        return observation, info

    def step(self, action: Vector) -> Step:
        pushed = 0 <= self._count() < self.duration and self.force > 0
        force = self._sign * self.force if pushed else 0.0
        if pushed:
            applied = self._bare.data.xfrc_applied[self._body]
            before = applied[0]
            applied[0] = before + force
        result = super().step(action)
        if pushed:
            # Restored, not subtracted: a rounding error would stay as a force.
            applied[0] = before
        flag(result[-1], pushed)["push_force"] = np.float64(force)
        return result
