"""States that policies fail from although there is a way back: who takes it?

A score under disturbances mixes states that every policy survives with states that no
policy can. Here the states are sorted beforehand, and a policy is asked from each.

Shapes: ``M`` states, ``Q`` positions, ``V`` velocities, ``K`` offsets, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import ArrayLike, NDArray

from torchrl_osr._checks import check_choice
from torchrl_osr._files import read_arrays
from torchrl_osr.lab.data.collect.environment import MAZE_IDS, environment_id
from torchrl_osr.lab.evaluation.episodes import EpisodeEvaluator, Policy
from torchrl_osr.lab.evaluation.statistics import percentile_interval, wilson_interval

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
            :class:`~torchrl_osr.lab.evaluation.DataDistance`.
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
        >>> from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states
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
        >>> from torchrl_osr.lab.evaluation.recoverable import (
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
    method: ArrayLike, baseline: ArrayLike, walk: ArrayLike, *, paired: bool = True
) -> tuple[float, float, float]:
    r"""Share of the states that the baseline loses that a method saves.

    .. math::
        R = \frac{p_{method} - p_{baseline}}{1 - p_{baseline}}

    with :math:`p` the share of states that :func:`recovers` is true of. There is a way
    back from each of them, so that 1 is what can be reached. Its 95 %
    percentile-bootstrap interval resamples seeds, and walks with all of their states.

    Args:
        method: whether it came back, for each seed and state, ``[N, M]``.
        baseline: the same of the baseline, ``[N, M]``.
        walk: of each state, ``[M]``.

    Keyword Args:
        paired: row by row method and baseline have the same seed, and are resampled
            together. Otherwise they may have different numbers of seeds. Default
            ``True``.

    Returns:
        The share, lower and upper end.

    Raises:
        ValueError: if the shapes do not fit, if there are no seeds or states, or
            numbers that are not finite, or if the baseline saves all states, in the
            data or in a resample: then there is nothing to share.

    Examples:
        >>> from torchrl_osr.lab.evaluation.recoverable import recovered_share
        >>> recovered_share([[1, 1, 1, 0]], [[1, 0, 0, 0]], walk=[5, 5, 5, 5])[0]
        0.6666666666666666
    """
    ours, theirs, sizes = _both_by_walk(method, baseline, walk, paired)
    seeds, walks, others = _weights(len(ours), len(sizes), len(theirs))
    baseline_seeds = seeds if paired else others
    total = walks @ sizes
    saved, before = (
        ((weight @ table) * walks).sum(-1) / len(table)
        for weight, table in ((seeds, ours), (baseline_seeds, theirs))
    )
    if (total - before <= 0).any():
        raise ValueError(
            "the baseline saves all states, so that there is no share to speak of; use "
            "more states, or another baseline."
        )
    return _with_interval((saved - before) / (total - before))


def saved_share(back: ArrayLike, walk: ArrayLike) -> tuple[float, float, float]:
    """Share of the states that a method saves.

    Its 95 % percentile-bootstrap interval resamples seeds, and walks with all of their
    states. Where all are saved, or none, no resample differs, and the interval is
    Wilson's of as many trials as there are walks.

    Args:
        back: whether it came back, for each seed and state, ``[N, M]``; or how often.
        walk: of each state, ``[M]``.

    Returns:
        The share, lower and upper end.

    Raises:
        ValueError: if the shapes do not fit, if there are no seeds or states, or
            numbers that are not finite.

    Examples:
        >>> from torchrl_osr.lab.evaluation.recoverable import saved_share
        >>> saved_share([[1, 0, 1, 0]], walk=[0, 0, 1, 1])
        (0.5, 0.5, 0.5)
        >>> share, low, high = saved_share([[0, 0, 0, 0]], walk=[0, 1, 2, 3])
        >>> share, low, round(high, 2)
        (0.0, 0.0, 0.49)
    """
    table, sizes = _by_walk(back, walk)
    for share, whole in ((0.0, 0.0 * sizes), (1.0, sizes)):
        if (table == whole).all():
            count = round(share * len(sizes))
            return (share, *wilson_interval(count, len(sizes)))
    return _share_of(table, sizes)


def saved_difference(
    method: ArrayLike, baseline: ArrayLike, walk: ArrayLike
) -> tuple[float, float, float]:
    """Share of the states that a method saves, less the share that a baseline saves.

    Its 95 % percentile-bootstrap interval resamples seeds, in pairs, and walks with all
    of their states. It has no width where every seed and walk has the same difference.

    Args:
        method: whether it came back, for each seed and state, ``[N, M]``; or how often.
        baseline: the same of the baseline, with the same seeds.
        walk: of each state, ``[M]``.

    Returns:
        The difference, lower and upper end.

    Raises:
        ValueError: if the shapes do not fit, if there are no seeds or states, or
            numbers that are not finite.

    Examples:
        >>> from torchrl_osr.lab.evaluation.recoverable import saved_difference
        >>> saved_difference([[1, 0, 1, 1]], [[0, 0, 0, 1]], walk=[0, 0, 1, 1])
        (0.5, 0.5, 0.5)
    """
    ours, theirs, sizes = _both_by_walk(method, baseline, walk)
    return _share_of(ours - theirs, sizes)


def _share_of(
    table: NDArray[np.float64], sizes: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Sums by seed and walk over the number of states, with their interval."""
    seeds, walks = _weights(len(table), len(sizes))
    saved = ((seeds @ table) * walks).sum(-1) / len(table)
    return _with_interval(saved / (walks @ sizes))


def _by_walk(
    table: ArrayLike, walk: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums over the states of each walk, ``[N, W]``, and their numbers, ``[W]``."""
    rows, of_each = np.asarray(table, dtype=np.float64), np.asarray(walk)
    if rows.ndim != 2 or not rows.size or of_each.shape != rows.shape[1:]:
        raise ValueError(
            "shares of states need a number for each seed and state [N, M] and a walk "
            f"for each state [M]; got {rows.shape} and {of_each.shape}."
        )
    if not np.isfinite(rows).all():
        raise ValueError("shares of states need finite numbers; some are not.")
    walks, number = np.unique(of_each, return_inverse=True)
    member = np.eye(len(walks))[number]
    return rows @ member, member.sum(0)


def _both_by_walk(
    method: ArrayLike, baseline: ArrayLike, walk: ArrayLike, paired: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Those of two methods, whose rows have the same seeds if they are paired."""
    ours, sizes = _by_walk(method, walk)
    theirs, _ = _by_walk(baseline, walk)
    if paired and len(ours) != len(theirs):
        raise ValueError(
            "paired rows of method and baseline have the same seeds; got "
            f"{len(ours)} and {len(theirs)} of them (recovered_share has paired=False "
            "for others)."
        )
    return ours, theirs, sizes


def _weights(*sizes: int) -> list[NDArray[np.float64]]:
    """How often each of them counts: once, then in each resample, ``[1 + R, size]``."""
    rng = np.random.default_rng(0)
    return [
        np.concatenate(
            [
                np.ones((1, size)),
                # In floating point: products of integers are not NumPy's strength.
                rng.multinomial(size, np.full(size, 1 / size), NUM_SHARE_RESAMPLES),
            ]
        )
        for size in sizes
    ]


def _with_interval(shares: NDArray[np.float64]) -> tuple[float, float, float]:
    """The first one, and the interval of the resamples behind it."""
    low, high = percentile_interval(shares[1:])
    return float(shares[0]), float(low), float(high)


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
