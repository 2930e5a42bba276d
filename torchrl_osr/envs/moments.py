"""Disturbances that last some steps of an episode: when they begin and end."""

from __future__ import annotations

from typing import Any, Literal

from torchrl_osr.envs.base import Disturbance, Vector, gymnasium
from torchrl_osr.envs.checks import check_count

At = int | Literal["random"]
"""Steps of the agent before the disturbance, or a moment drawn for each episode."""


class TimedDisturbance(Disturbance):
    """Abstract base of what acts for ``duration`` steps, once an episode.

    At a fixed moment every episode is met in much the same phase of the gait, and the
    result is a lottery of that phase; ``"random"`` averages over it.

    Args:
        env: the environment.
        at: number of the agent's steps before it, or ``"random"``.
        window: first moment and the one after the last, for ``"random"``.
        first: the earliest moment allowed.
    """

    def __init__(
        self,
        env: gymnasium.Env[Vector, Vector],
        *,
        at: At,
        window: tuple[int, int],
        first: int = 0,
    ) -> None:
        if at != "random":
            check_count("at", at, first, or_else="the string 'random'")
        start, end = window
        check_count("the start of window", start, first)
        check_count("the end of window", end, start + 1)
        super().__init__(env)
        self.at, self.window = at, (start, end)
        self._start = self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        observation, info = super().reset(seed=seed, options=options)
        if self.at == "random":
            self._start = int(self._generator.integers(*self.window))
        else:
            self._start = self.at
        self._steps = 0
        return observation, info

    def _count(self) -> int:
        """Count a step of the agent and return its number from the moment on.

        It is 0 for the first step that the disturbance may act in, negative before.
        """
        number = self._steps - self._start
        self._steps += 1
        return number
