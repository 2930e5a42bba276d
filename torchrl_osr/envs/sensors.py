"""Noise of the sensors: observations that differ from the true state."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from torchrl_osr._checks import check_choice
from torchrl_osr.envs.disturbance import (
    DisturbanceWrapper,
    Step,
    Vector,
    check_strength,
    gymnasium,
    vector_box,
)


class ObservationNoise(DisturbanceWrapper):
    r"""Noise on every observation; the simulated state is unchanged.

    The noise of "DMBP: Diffusion Model-Based Predictor for Robust Offline
    Reinforcement Learning against State Observation Perturbations" (ICLR 2024), which
    is absolute; with ``unit`` it is relative to the data, as in RORL,
    https://arxiv.org/abs/2206.02829. The first observation of an episode is noisy, too.
    Bounds of the observation space are not enforced.

    Args:
        env: the environment, with real observations.
        std: standard deviation, in ``unit``; 0 is off.

    Keyword Args:
        kind: ``"gaussian"`` (default), or ``"uniform"`` with the same standard
            deviation (half-width :math:`\sqrt 3` times ``std``).
        unit: the data's standard deviation in each dimension, in the shape of an
            observation. Default: 1, ``std`` is in the observation's own units.

    Raises:
        ValueError: if ``std`` or a number of ``unit`` is negative, ``kind`` unknown, or
            ``unit`` of another shape.
        TypeError: if observations are not a Box.

    Examples:
        >>> from torchrl_osr.data import make_environment
        >>> from torchrl_osr.envs import ObservationNoise
        >>> env = ObservationNoise(make_environment("Hopper-v5"), 0.1)
        >>> observation, _ = env.reset(seed=0)
        >>> clean, _ = make_environment("Hopper-v5").reset(seed=0)
        >>> bool((abs(observation - clean) > 0).all())
        True
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        std: float,
        *,
        kind: Literal["gaussian", "uniform"] = "gaussian",
        unit: ArrayLike | None = None,
    ) -> None:
        check_strength("std", std)
        check_choice("kind", kind, ("gaussian", "uniform"))
        super().__init__(env, always=std > 0)
        shape = vector_box(env.observation_space, "observations").shape
        scale = np.ones(shape) if unit is None else np.asarray(unit, dtype=np.float64)
        if scale.shape != shape:
            raise ValueError(
                f"unit has shape {scale.shape}, but observations have {shape}; pass "
                "one standard deviation for each number of an observation."
            )
        if not (np.isfinite(scale) & (scale >= 0)).all():
            raise ValueError(f"unit must be finite and at least 0, got {scale}.")
        self.std, self.kind = std, kind
        self._scale = std * scale

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        return self._seen(observation), info

    def step(self, action: Vector) -> Step:
        observation, *rest = super().step(action)
        return self._seen(observation), *rest

    def _seen(self, observation: Vector) -> Vector:
        if self.std == 0:
            return observation
        if self.kind == "gaussian":
            noise = self._generator.standard_normal(observation.shape)
        else:
            noise = self._generator.random(observation.shape) * 12**0.5 - 3**0.5
        return (observation + self._scale * noise).astype(observation.dtype)
