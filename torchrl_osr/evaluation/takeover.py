"""A disturbance, and then: several controllers go on from the very same state.

The behaviour policy plays until the disturbance is over, whoever is tested plays from
then on. What becomes of the episode is then up to them alone, and not to the state in
which each would have met the disturbance.

Shapes: ``E`` episodes, ``S`` observation, ``A`` action, ``Q`` joint positions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_osr.evaluation.data_distance import DataDistance
from torchrl_osr.evaluation.episodes import EpisodeEvaluator, Policy, Wrap
from torchrl_osr.evaluation.recovery import Recorder, disturbed_at, measure_recovery
from torchrl_osr.evaluation.survival import Survival, steps_alive

NEVER = torch.iinfo(torch.int64).max
"""When somebody takes over in an episode that meets no disturbance."""

BEHAVIOR = "behaviour policy"
"""Name of the controller that plays on when the disturbance is over."""

Controller = Callable[[list[Tensor]], Policy]
"""Makes a policy for one evaluation.

It is given the behaviour policy's undisturbed episodes, raw observations ``[T, S]`` of
each from the reset on.
"""


class PoseRecorder(Recorder):
    """Keeps what a film needs beside the trajectories.

    Args:
        environments: of the evaluation, MuJoCo's.

    Attributes:
        poses: joint positions at each entry of each episode, ``[Q]`` each.
        forces: the push that each episode met, with its sign; 0 if none.
        returns: sum of rewards of each episode.
    """

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]]) -> None:
        super().__init__(len(environments))
        self._simulations: list[Any] = [each.unwrapped for each in environments]
        self.poses: list[list[NDArray[np.float64]]] = [[] for _ in environments]
        self.forces = [0.0] * len(environments)
        self.returns: list[float] = []

    def __call__(
        self,
        episode: int,
        observation: NDArray[Any],
        terminated: bool,
        info: dict[str, Any],
    ) -> None:
        super().__call__(episode, observation, terminated, info)
        self.poses[episode].append(self._simulations[episode].data.qpos.copy())
        self.forces[episode] = info.get("push_force") or self.forces[episode]


class Takeover(NamedTuple):
    """One controller's episodes.

    Attributes:
        disturbed: with the disturbance.
        clean: without it; the controller takes over at the same moments.
    """

    disturbed: PoseRecorder
    clean: PoseRecorder

    def up_clean(self, moments: Tensor, steps: int) -> list[int]:
        """Return which episodes meet a disturbance, and without it last that long.

        Args:
            moments: when it was over, int64 ``[E]``, or :data:`NEVER`.
            steps: without a fall after it.
        """
        pairs = zip(self.clean.trajectories, moments.tolist(), strict=True)
        # A difference, since NEVER plus anything overflows.
        return [
            episode
            for episode, (trajectory, moment) in enumerate(pairs)
            if trajectory.last - trajectory.terminated - moment >= steps
        ]

    def survival(
        self,
        episodes: Sequence[int],
        moments: Tensor,
        distance: DataDistance,
        horizons: tuple[int, ...],
    ) -> Survival:
        """Return what became of some of the episodes.

        Args:
            episodes: their numbers; each met the disturbance.
            moments: when it was over, int64 ``[E]``.
            distance: to the data.
            horizons: see :class:`~torchrl_osr.evaluation.survival.Survival`.
        """
        disturbed, clean = (
            [recorder.trajectories[episode] for episode in episodes]
            for recorder in self
        )
        ends = moments[list(episodes)].tolist()
        alive, alive_clean = (
            [
                steps_alive(trajectory, end, horizons[-1])
                for trajectory, end in zip(some, ends, strict=True)
            ]
            for some in (disturbed, clean)
        )
        steps = measure_recovery(disturbed, clean, distance).steps
        returns = [self.disturbed.returns[episode] for episode in episodes]
        return Survival(horizons, returns, alive, alive_clean, steps)


def hand_over(before: Policy, after: Policy, moments: Tensor) -> Policy:
    """Return a policy that is one until a moment and another from then on.

    Both are asked in every step, so that a controller that counts its calls knows the
    time. It counts itself, too: for one evaluation, with all rows in every call.

    Args:
        before: acts first.
        after: takes over.
        moments: steps of each row before it does, int64 ``[E]``.
    """
    step = 0

    def policy(observation: Tensor) -> Tensor:
        nonlocal step
        first, second = before(observation), after(observation)
        over = (step >= moments)[:, None]
        step += 1
        return torch.where(over, second, first)

    return policy


def play_takeovers(
    env_id: str,
    behavior: Policy,
    controllers: Mapping[str, Controller],
    disturbance: Wrap,
    *,
    duration: int,
    latest: int,
    after: int,
    num_episodes: int = 20,
    seed: int = 0,
) -> tuple[dict[str, Takeover], Tensor]:
    """Play every controller's episodes, disturbed and clean.

    Args:
        env_id: a Gymnasium id of a MuJoCo task.
        behavior: plays first; the same observation gives the same action.
        controllers: by name, who takes over.
        disturbance: wraps the environment, acts once an episode.

    Keyword Args:
        duration: of the disturbance, in steps.
        latest: step that it has begun at.
        after: steps that are played at least after its end.
        num_episodes: ``E``. Default 20.
        seed: the episodes are seeded ``seed, seed + 1, ...``. Default 0.

    Returns:
        By name, the behaviour policy first as :data:`BEHAVIOR`; and the entry after
        each episode's disturbance, which the controller takes over at, int64 ``[E]``,
        :data:`NEVER` where the behaviour policy fell before.
    """

    def play(policy: Policy, wrap: Wrap) -> PoseRecorder:
        limit = latest + duration + after
        evaluator = EpisodeEvaluator(
            env_id, num_episodes=num_episodes, seed=seed, fixed_batch=True,
            wrap=lambda env: gymnasium.wrappers.TimeLimit(wrap(env), limit),
        )  # fmt: skip
        recorder = PoseRecorder(evaluator.environments)
        recorder.returns = evaluator(policy, recorder).returns.tolist()
        evaluator.close()
        return recorder

    wraps: tuple[Wrap, Wrap] = (disturbance, lambda env: env)
    played = {BEHAVIOR: Takeover(*(play(behavior, wrap) for wrap in wraps))}
    begins = map(disturbed_at, played[BEHAVIOR].disturbed.trajectories)
    moments = torch.tensor([NEVER if at is None else at + duration for at in begins])
    references = [
        torch.from_numpy(np.stack(each.observations))
        for each in played[BEHAVIOR].clean.trajectories
    ]
    for name, make in controllers.items():
        # A controller that counts its calls is for one evaluation: two are made.
        played[name] = Takeover(
            *(
                play(hand_over(behavior, make(references), moments), wrap)
                for wrap in wraps
            )
        )
    return played, moments
