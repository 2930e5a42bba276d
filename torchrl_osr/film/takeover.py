"""Several controllers that go on from the same state after a disturbance.

One policy, the behaviour policy where there is one, plays until the disturbance is
over; then the controller that is tested takes over.

Shapes: ``E`` episodes, ``S`` observation, ``A`` action, ``Q`` joint positions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_osr.evaluation import (
    DataDistance,
    EpisodeEvaluator,
    Policy,
    Recorder,
    Trajectory,
    Wrap,
    disturbed_at,
    measure_recovery,
    wilson_interval,
)
from torchrl_osr.evaluation.robustness import aligned_columns

NEVER = torch.iinfo(torch.int64).max
"""Moment of the takeover in an episode without a disturbance."""

BEHAVIOR = "behaviour policy"
"""Name of the behaviour policy among the controllers."""

Controller: TypeAlias = Callable[[list[Tensor]], Policy]
"""Makes a policy for one evaluation from the first policy's undisturbed episodes.

Of each, the raw observations ``[T, S]`` from the reset on.
"""


def steps_alive(trajectory: Trajectory, moment: int, steps: int) -> int:
    """Steps without a fall after the entry ``moment``, at most ``steps``."""
    # The last entry of a fallen one is the fall. NEVER is later than all entries.
    return max(min(trajectory.last - trajectory.terminated - moment, steps), 0)


@dataclass(frozen=True)
class Survival:
    """Survival and recovery of one controller, one entry an episode.

    Attributes:
        horizons: steps after the disturbance at which survivors are counted, ascending.
        returns: undiscounted sum of rewards.
        alive: steps without a fall after it, at most the last horizon.
        alive_clean: the same in the undisturbed episode, after the same moment.
        steps_back: steps until back in the data, ``None`` if never.
    """

    horizons: tuple[int, ...]
    returns: list[float]
    alive: list[int]
    alive_clean: list[int]
    steps_back: list[int | None]

    @property
    def up(self) -> list[bool]:
        """Whether it had not fallen at the last horizon."""
        return [steps >= self.horizons[-1] for steps in self.alive]

    def count(self, horizon: int, *, clean: bool = False) -> int:
        """Number of episodes without a fall until then."""
        alive = self.alive_clean if clean else self.alive
        return sum(steps >= horizon for steps in alive)


class PoseRecorder(Recorder):
    """Keeps trajectories and the poses of the robot.

    Attributes:
        poses: joint positions at each entry of each episode, ``[Q]`` each.
        forces: of the push in each episode, with its sign; 0 if there was none.
        returns: sum of rewards of each episode.
    """

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]]) -> None:
        super().__init__(len(environments))
        self._simulations: list[Any] = [each.unwrapped for each in environments]
        self.poses: list[list[NDArray[np.float64]]] = [[] for _ in environments]
        self.forces = [0.0] * len(environments)
        self.returns: list[float] = []

    def __call__(
        self, episode: int, observation: Any, terminated: bool, info: dict[str, Any]
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
        """Numbers of the episodes without a fall in the ``steps`` after the moments.

        Of the clean ones, for the ``moments`` that :func:`play_takeovers` returned.
        """
        return [
            episode
            for episode, trajectory in enumerate(self.clean.trajectories)
            if steps_alive(trajectory, int(moments[episode]), steps) == steps
        ]

    def survival(
        self,
        episodes: Sequence[int],
        moments: Tensor,
        distance: DataDistance,
        horizons: tuple[int, ...],
    ) -> Survival:
        """Survival and recovery in the numbered episodes, which met the disturbance."""
        survival = Survival(horizons, [], [], [], [])
        for episode in episodes:
            disturbed, clean = (each.trajectories[episode] for each in self)
            end = int(moments[episode])
            survival.returns.append(self.disturbed.returns[episode])
            survival.alive.append(steps_alive(disturbed, end, horizons[-1]))
            survival.alive_clean.append(steps_alive(clean, end, horizons[-1]))
            steps = measure_recovery(disturbed, clean, distance).steps
            survival.steps_back.append(steps)
        return survival


def hand_over(before: Policy, after: Policy, moments: Tensor) -> Policy:
    """One policy for the first ``moments`` steps of each row, and then another one.

    Both are called in every step, so that a controller that counts its calls knows the
    time. This one counts its calls, too: it is for one evaluation.
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
    first: Policy,
    controllers: Mapping[str, Controller],
    disturbance: Wrap,
    *,
    name: str = BEHAVIOR,
    duration: int,
    latest: int,
    after: int,
    num_episodes: int = 20,
    seed: int = 0,
) -> tuple[dict[str, Takeover], Tensor]:
    """Play every controller's episodes, disturbed and clean.

    Args:
        env_id: a Gymnasium id of a MuJoCo task.
        first: the policy that plays first, deterministic; it is a controller itself.
        controllers: the others, by name.
        disturbance: wraps the environment, acts once an episode.

    Keyword Args:
        name: of the first policy. Default: it is the behaviour policy.
        duration: of the disturbance, in steps.
        latest: step at which it begins at the latest.
        after: steps that are played after its end, at least.
        num_episodes: ``E``. Default 20.
        seed: the episodes are seeded ``seed, seed + 1, ...``. Default 0.

    Returns:
        Episodes by controller, those of the first policy first; and the entry after
        each episode's disturbance, at which the controller takes over, int64 ``[E]``,
        :data:`NEVER` where the first policy fell before.
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

    def both(disturbed: Policy, clean: Policy) -> Takeover:
        return Takeover(play(disturbed, disturbance), play(clean, lambda env: env))

    played = {name: both(first, first)}
    begins = map(disturbed_at, played[name].disturbed.trajectories)
    moments = torch.tensor([NEVER if at is None else at + duration for at in begins])
    references = [
        torch.from_numpy(np.stack(each.observations))
        for each in played[name].clean.trajectories
    ]
    for other, make in controllers.items():
        # One policy for each evaluation: it may count its calls.
        policies = [hand_over(first, make(references), moments) for _ in range(2)]
        played[other] = both(*policies)
    return played, moments


def survival_table(controllers: Mapping[str, Survival]) -> str:
    """Text table with one line for each controller, the first being the reference.

    The last column counts pairs of episodes: in how many only this controller was up at
    the last horizon, and in how many only the reference.
    """
    reference = next(iter(controllers.values()))
    total, last = len(reference.alive), reference.horizons[-1]
    titles = [f"up after {each}" for each in reference.horizons]
    titles += ["95 % interval", f"undisturbed {last}", "back in data", "only it/first"]
    rows = [["", *titles]]
    for name, each in controllers.items():
        low, high = wilson_interval(each.count(last), total)
        back = [steps for steps in each.steps_back if steps is not None]
        median = f" in {np.median(back):.0f}" if back else ""
        up = list(zip(each.up, reference.up, strict=True))
        only_it, only_reference = up.count((True, False)), up.count((False, True))
        rows.append(
            [
                name,
                *(str(each.count(horizon)) for horizon in each.horizons),
                f"{100 * low:.0f}-{100 * high:.0f} %",
                str(each.count(last, clean=True)),
                f"{len(back)}{median}",
                "" if each is reference else f"{only_it}/{only_reference}",
            ]
        )
    return "\n".join(line.rstrip() for line in aligned_columns(rows))
