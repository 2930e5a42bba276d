"""States that policies fail from although there is a way back: who takes it?

A score under disturbances mixes states that every policy survives with states that no
policy can. Here the states are sorted beforehand, and a policy is asked from each.

Shapes: ``M`` states, ``Q`` positions, ``V`` velocities, ``K`` offsets, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import ArrayLike, NDArray

from torchrl_osr._checks import check_choice
from torchrl_osr._files import read_arrays
from torchrl_osr.data.collect.environment import MAZE_IDS, environment_id
from torchrl_osr.evaluation.episodes import EpisodeEvaluator, Policy
from torchrl_osr.evaluation.statistics import percentile_interval

GROUPS = ("easy", "contested", "recoverable")
"""No policy of the jury failed; some did; all did, and a planner did not."""

SPEED_STEPS = 50
"""HalfCheetah's speed is its mean over the last so many steps."""

NUM_SHARE_RESAMPLES = 10_000

AT_ONCE = 16

STATES = Path(__file__).parent / "states"
"""Those that ship: a file for each task and half."""

HALVES = ("public", "held-out")
"""To choose by; and for one look at what is finished."""


@dataclass(frozen=True, eq=False)
class RecoverableStates:
    """States of one task, see ``results/recovery/CARD.md``, ``[M]`` each.

    Attributes:
        env_name: short name of the task, ``"walker2d"`` for instance.
        qpos: positions of the simulation, ``[M, Q]``.
        qvel: velocities, ``[M, V]``.
        goal: in a maze, metres, ``[M, 2]``; elsewhere ``[M, 0]``.
        group: of :data:`GROUPS`.
        walk: number of the undisturbed walk a state comes from; states of one walk are
            alike.
        moment: step of the walk at which it was disturbed.
        kind: of disturbance.
        strength: of the disturbance, in the kind's unit.
        distance: to the expert's data, in units of the threshold of
            :class:`~torchrl_osr.evaluation.DataDistance`.
        offsets: of the witness, ``[M, K, A]``, each held for ``hold`` steps: added to
            the actions of the expert, who then goes on alone. 0 if not recoverable.
        hold: steps, a scalar.
        steps: for which a policy is played from each state, a scalar.
        least_speed: that HalfCheetah must regain, m/s, a scalar; elsewhere minus
            infinity.
    """

    env_name: str
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    goal: NDArray[np.float64]
    group: NDArray[Any]
    walk: NDArray[np.int32]
    moment: NDArray[np.int32]
    kind: NDArray[Any]
    strength: NDArray[np.float64]
    distance: NDArray[np.float32]
    offsets: NDArray[np.float32]
    hold: int
    steps: int
    least_speed: float

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def disturbance(self) -> list[str]:
        """Kind and strength of each, ``"torque 10"`` for instance."""
        of_each = zip(self.kind, self.strength, strict=True)
        return [f"{kind} {strength:g}" for kind, strength in of_each]


def disturbances_of(names: Iterable[str]) -> list[str]:
    """The disturbances among some, each once, by kind and strength."""

    def order(name: str) -> tuple[str, float]:
        kind, strength = name.rsplit(" ", 1)
        return kind, float(strength)

    return sorted({*names}, key=order)


def load_recoverable_states(env_name: str, half: str = "public") -> RecoverableStates:
    """Load the states of one task that ship with the package.

    Args:
        env_name: ``"hopper"``, ``"walker2d"``, ``"halfcheetah"`` or
            ``"pointmaze-medium"``.
        half: ``"public"``, to choose by, or ``"held-out"``, for one look at what is
            finished. Default ``"public"``.

    Raises:
        ValueError: there are none.

    Examples:
        >>> from torchrl_osr.evaluation.recoverable import load_recoverable_states
        >>> states = load_recoverable_states("walker2d")
        >>> states.qpos.shape[1], sorted(set(states.group.tolist()))
        (9, ['contested', 'easy', 'recoverable'])
    """
    check_choice("half", half, HALVES)
    path = STATES / f"{env_name}-{half}.npz"
    if not path.exists():
        there = sorted(each.stem for each in STATES.glob(f"*-{half}.npz"))
        names = ", ".join(each.removesuffix(f"-{half}") for each in there)
        raise ValueError(
            f"there are no recoverable states of {env_name!r}; there are of: {names}."
        )
    return read_recoverable_states(path)


def read_recoverable_states(path: Path | str) -> RecoverableStates:
    """Read the states of one task and half from a file.

    Args:
        path: an ``.npz`` with the arrays of :class:`RecoverableStates`.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, or something else.
    """
    arrays: dict[str, Any] = read_arrays(Path(path))
    names = {field.name for field in fields(RecoverableStates)}
    if set(arrays) != names:
        wrong = ", ".join(sorted(set(arrays) ^ names))
        raise ValueError(
            f"{path} holds no recoverable states: missing or unknown are the arrays "
            f"{wrong}."
        )
    kinds = {"env_name": str, "hold": int, "steps": int, "least_speed": float}
    arrays |= {name: kind(arrays[name]) for name, kind in kinds.items()}
    return RecoverableStates(**arrays)


def recovers(states: RecoverableStates, policy: Policy) -> NDArray[np.bool_]:
    """Whether a policy comes back from each state, ``[M]``.

    Hopper and Walker2d: it has not fallen after ``steps`` steps. HalfCheetah: its mean
    speed over the last 50 of them is at least ``least_speed``. Maze: it has reached
    the goal by then.

    Args:
        states: from :func:`load_recoverable_states`.
        policy: is called once a step, with all states that are being played.

    Examples:
        >>> import torch
        >>> from torchrl_osr.evaluation.recoverable import (
        ...     load_recoverable_states, recovers)
        >>> states = load_recoverable_states("walker2d")
        >>> back = recovers(states, lambda state: torch.zeros(len(state), 6))
        >>> bool(back.any())
        False
    """
    back = np.zeros(len(states), dtype=np.bool_)
    if not len(states):
        return back
    waiting = iter(range(len(states)))
    evaluator = EpisodeEvaluator(
        environment_id(states.env_name),
        num_episodes=min(AT_ONCE, len(states)),
        fixed_batch=True,  # falls are chaotic: rounding decides some of them
        wrap=lambda env: TimeLimit(_Start(env, states, waiting), states.steps),
    )
    for first in range(0, len(states), AT_ONCE):
        stood = np.ones(len(evaluator.environments), dtype=np.bool_)
        speeds: list[list[float]] = [[] for _ in stood]

        def watch(
            episode: int,
            _: Any,
            terminated: bool,
            info: dict[str, Any],
            stood: NDArray[np.bool_] = stood,
            speeds: list[list[float]] = speeds,
        ) -> None:
            stood[episode] &= not terminated
            speeds[episode].append(float(info.get("x_velocity", 0.0)))

        results = evaluator(policy, watch)
        speed = np.array([np.mean(each[-SPEED_STEPS:]) for each in speeds])
        good = stood & (speed >= states.least_speed)
        if results.successes is not None:
            good = results.successes
        back[first:][:AT_ONCE] = good[: len(states) - first]
    evaluator.close()
    return back


def recovered_share(
    method: ArrayLike, baseline: ArrayLike, oracle: ArrayLike, walk: ArrayLike
) -> tuple[float, float, float]:
    r"""Share of what the oracle saves and the baseline loses that a method saves.

    .. math::
        R = \frac{p_{method} - p_{baseline}}{p_{oracle} - p_{baseline}}

    with :math:`p` the share of states that :func:`recovers` is true of. Its 95 %
    percentile-bootstrap interval resamples seeds, the same ones for method and
    baseline, and walks, each with all of its states.

    Args:
        method: whether it came back, for each seed and state, ``[N, M]``.
        baseline: the same of the baseline with the same seeds, ``[N, M]``.
        oracle: the same of the oracle, ``[M]``.
        walk: of each state, ``[M]``.

    Returns:
        The share, lower and upper end.

    Raises:
        ValueError: if the shapes do not fit, or the oracle saves no more states than
            the baseline, in the data or in a resample: then there is nothing to share.

    Examples:
        >>> recovered_share(
        ...     [[1, 1, 1, 0]], [[1, 0, 0, 0]], oracle=[1, 1, 1, 1], walk=[5, 5, 5, 5]
        ... )[0]
        0.6666666666666666
    """
    each = [np.asarray(table, dtype=np.float64) for table in (method, baseline, oracle)]
    walks, number = np.unique(np.asarray(walk), return_inverse=True)
    shape = each[0].shape
    if len(shape) != 2 or each[1].shape != shape or {*shape[1:]} != {
        *each[2].shape, *number.shape
    }:  # fmt: skip
        shapes = [table.shape for table in each]
        raise ValueError(
            "recovered_share needs a method and a baseline [N, M], an oracle [M] and "
            f"walks [M]; got {shapes} and {number.shape}."
        )
    member = np.eye(len(walks))[number]
    method_sum, baseline_sum, oracle_sum = (table @ member for table in each)

    def shares(seed_weight: Any, walk_weight: Any) -> NDArray[np.float64]:
        ours, theirs = (
            ((seed_weight @ table) * walk_weight).sum(-1) / len(baseline_sum)
            for table in (method_sum, baseline_sum)
        )
        left: NDArray[np.float64] = walk_weight @ oracle_sum - theirs
        if (left <= 0).any():
            raise ValueError(
                "the oracle saves no more states than the baseline, so that there is "
                "no share to speak of; use more states, or another baseline."
            )
        share: NDArray[np.float64] = (ours - theirs) / left
        return share

    return _with_interval(shares, len(baseline_sum), len(walks))


def saved_share(back: ArrayLike, walk: ArrayLike) -> tuple[float, float, float]:
    """Share of the states that a method saves.

    Its 95 % percentile-bootstrap interval resamples seeds, and walks with all of their
    states.

    Args:
        back: whether it came back, for each seed and state, ``[N, M]``; or how often.
        walk: of each state, ``[M]``.

    Returns:
        The share, lower and upper end.

    Examples:
        >>> saved_share([[1, 0, 1, 0]], walk=[0, 0, 1, 1])
        (0.5, 0.5, 0.5)
    """
    walks, number = np.unique(np.asarray(walk), return_inverse=True)
    member = np.eye(len(walks))[number]
    table, sizes = np.asarray(back, dtype=np.float64) @ member, member.sum(0)

    def shares(seed_weight: Any, walk_weight: Any) -> NDArray[np.float64]:
        saved = ((seed_weight @ table) * walk_weight).sum(-1) / len(table)
        share: NDArray[np.float64] = saved / (walk_weight @ sizes)
        return share

    return _with_interval(shares, len(table), len(walks))


def _with_interval(
    shares: Callable[[Any, Any], NDArray[np.float64]], seeds: int, walks: int
) -> tuple[float, float, float]:
    """A share that depends on how often each seed and walk counts, ``[R, seeds]``."""
    value = shares(np.ones((1, seeds)), np.ones((1, walks)))
    rng = np.random.default_rng(0)
    weights = (
        # In floating point: products of integers are not NumPy's strength.
        rng.multinomial(size, np.full(size, 1 / size), NUM_SHARE_RESAMPLES) * 1.0
        for size in (seeds, walks)
    )
    low, high = percentile_interval(shares(*weights))
    return float(value[0]), float(low), float(high)


class _Start(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Begins each episode in the next of the states that wait, or in the first."""

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        states: RecoverableStates,
        waiting: Iterator[int],
    ) -> None:
        super().__init__(env)
        self.states, self.waiting = states, waiting

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        _, info = super().reset(**options)
        number = next(self.waiting, 0)
        bare: Any = self.unwrapped
        state = self.states.qpos[number], self.states.qvel[number]
        if self.states.env_name not in MAZE_IDS:
            bare.set_state(*state)
            return bare._get_obs(), info
        bare.goal = self.states.goal[number].copy()
        bare.update_target_site_pos()
        bare.point_env.set_state(*state)
        observation = bare._get_obs(bare.point_env._get_obs()[0])
        space = bare.observation_space
        return gymnasium.spaces.flatten(space, observation), info
