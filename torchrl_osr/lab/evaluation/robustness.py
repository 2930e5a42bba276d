"""Episodes with and without a disturbance, in pairs: same policy, same start state.

Played by :func:`evaluate_paired`, kept as JSON by :func:`evaluation_json`, averaged by
:func:`summarize_disturbances`. How it is measured is in ``docs/robustness.md``.

Shapes: ``E`` pairs of episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_osr._checks import check_positive
from torchrl_osr.lab.data import ReferenceReturns
from torchrl_osr.lab.evaluation.data_distance import DataDistance
from torchrl_osr.lab.evaluation.episodes import (
    EpisodeEvaluator,
    EpisodeResults,
    Policy,
    Wrap,
    measure_of,
)
from torchrl_osr.lab.evaluation.recovery import (
    STEPS_AFTER,
    STEPS_BEFORE,
    Recorder,
    Recovery,
    disturbed_at,
    measure_recovery,
)
from torchrl_osr.lab.evaluation.statistics import (
    NUM_RESAMPLES,
    mean_interval,
    percentile_interval,
)

TRANSIENT = ("knock", "push", "start")
"""Kinds of disturbance that end, so that there is something to recover from."""

RECOVERY_ENTRIES = (
    "ended_at", "survived_knock", "alive_after", "clean_alive_after", "recovery_steps",
    "distance",
)  # fmt: skip
"""Of a disturbance's JSON; ``None`` if it does not end."""

COLUMNS = (
    "loss %", "[95 %]", "met it", f"alive +{STEPS_AFTER}", "(clean)", "back",
    "steps back",
)  # fmt: skip
"""Of the table, behind the disturbance and the score or return without and with it."""


@dataclass(frozen=True)
class Disturbance:
    """One kind of disturbance at one strength.

    Attributes:
        name: unique in its suite.
        kind: of the disturbance; those of :data:`TRANSIENT` end.
        strength: in the unit of its kind.
        wrap: puts the disturbance around an environment. Default: nothing.
        policy: an attacked one, in the place of the evaluated one. Default: none.
    """

    name: str
    kind: str
    strength: float
    wrap: Wrap | None = None
    policy: Policy | None = None


class DisturbanceResults(NamedTuple):
    """Episodes under one disturbance.

    Attributes:
        disturbance: which one.
        results: returns, lengths and seeds, ``[E]`` each.
        disturbed_at: step of the first disturbance of each episode, from 0; ``None``
            where the episode ended before it, or there is none.
        recovery: of each episode, ``[E]``; ``None`` if the disturbance does not end.
    """

    disturbance: Disturbance
    results: EpisodeResults
    disturbed_at: list[int | None]
    recovery: list[Recovery] | None


class PairedResults(NamedTuple):
    """Clean episodes, and those with the same seeds under each of the disturbances."""

    clean: EpisodeResults
    disturbed: list[DisturbanceResults]


def evaluate_paired(
    policy: Policy,
    env_id: str,
    disturbances: Sequence[Disturbance],
    distance: DataDistance,
    *,
    num_episodes: int = 10,
    seed: int = 0,
    advance: Callable[[], object] = lambda: None,
) -> PairedResults:
    """Play clean episodes once, and the same episodes under each disturbance.

    Episodes of a pair have the same seed, hence the same start state, and the policy
    is called with batches of one size: until the disturbance acts they are equal, bit
    for bit. Every disturbance has environments of its own.

    Args:
        policy: to be evaluated, on the CPU.
        env_id: a Gymnasium id, ``"Hopper-v5"`` for instance.
        disturbances: of one suite.
        distance: to the data that the policy was trained on.

    Keyword Args:
        num_episodes: ``E``, at least 2. Default 10.
        seed: the episodes are seeded ``seed, seed + 1, ...``. Default 0.
        advance: called after the clean episodes and after each disturbance.

    Raises:
        ValueError: if ``num_episodes`` is below 2, two disturbances have one name, or
            one of them is not possible for this environment.
    """
    check_positive("num_episodes", num_episodes, minimum=2)
    check_disturbances(env_id, disturbances)

    def play(policy: Policy, wrap: Wrap | None) -> tuple[EpisodeResults, Recorder]:
        evaluator = EpisodeEvaluator(
            env_id, num_episodes=num_episodes, seed=seed, wrap=wrap, fixed_batch=True
        )
        recorder = Recorder(num_episodes)
        with closing(evaluator):
            results = evaluator(policy, recorder)
        advance()
        return results, recorder

    clean, undisturbed = play(policy, None)
    played = []
    for each in disturbances:
        results, recorder = play(each.policy or policy, each.wrap)
        moments: list[int | None] = [0] * num_episodes  # an attack: in every step
        if each.policy is None:
            moments = [disturbed_at(episode) for episode in recorder.trajectories]
        recovery = None
        if each.kind in TRANSIENT:
            pairs = zip(recorder.trajectories, undisturbed.trajectories, strict=True)
            recovery = [measure_recovery(*pair, distance) for pair in pairs]
        played.append(DisturbanceResults(each, results, moments, recovery))
    return PairedResults(clean, played)


def check_disturbances(env_id: str, disturbances: Sequence[Disturbance]) -> None:
    """Raise a ValueError unless all have their own names and fit the environment."""
    names = [each.name for each in disturbances]
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"disturbances need one name each, got {names}.")
    for name, reason in impossible_disturbances(env_id, disturbances).items():
        raise ValueError(_not_possible(name, env_id, reason))


def impossible_disturbances(
    env_id: str, disturbances: Sequence[Disturbance]
) -> dict[str, str]:
    """Those that need what the environment lacks, and why, by name.

    Raises:
        ValueError: a disturbance is not what any environment could have.
    """
    from torchrl_osr.lab.envs import NotPossible  # needs MuJoCo, and the rest does not

    reasons = {}
    for each in disturbances:
        try:
            EpisodeEvaluator(env_id, num_episodes=1, wrap=each.wrap).close()
        except NotPossible as error:
            reasons[each.name] = str(error)
        except (TypeError, ValueError) as error:
            raise ValueError(_not_possible(each.name, env_id, error)) from error
    return reasons


def _not_possible(name: str, env_id: str, reason: object) -> str:
    return f"disturbance {name!r} is not possible for {env_id}: {reason}"


def decrease_interval(
    clean: ArrayLike, disturbed: ArrayLike
) -> tuple[float | None, float | None, float | None]:
    """Decrease of the mean score in percent, with its 95 % paired-bootstrap interval.

    Pairs of episodes are resampled together, so that what both have in common does not
    widen the interval.

    Args:
        clean, disturbed: scores or returns of the pairs, ``[E]`` each.

    Returns:
        ``100 (1 - mean(disturbed) / mean(clean))``, lower and upper end. All three are
        ``None`` for fewer than two pairs or a clean mean that is not above 0, the ends
        alone if that is so in a resample.

    Examples:
        >>> decrease_interval([40.0, 60.0], [20.0, 30.0])
        (50.0, 50.0, 50.0)
    """
    pairs = np.stack([np.asarray(clean, float), np.asarray(disturbed, float)])
    if pairs.shape[1] < 2 or pairs[0].mean() <= 0:
        return None, None, None
    clean_mean, disturbed_mean = pairs.mean(1)
    decrease = float(100 * (1 - disturbed_mean / clean_mean))
    rng = np.random.default_rng(0)
    rows = rng.integers(pairs.shape[1], size=(NUM_RESAMPLES, pairs.shape[1]))
    resampled_clean, resampled = pairs[:, rows].mean(-1)
    if (resampled_clean <= 0).any():
        return decrease, None, None
    low, high = percentile_interval(100 * (1 - resampled / resampled_clean))
    return decrease, float(low), float(high)


def evaluation_json(
    step: int, paired: PairedResults, references: ReferenceReturns | None
) -> dict[str, Any]:
    """Raw results of the checkpoint after ``step`` gradient steps, JSON-compatible.

    Besides the returns ``"scores"`` that are normalised by the references, if any.
    """
    return {
        "step": step,
        "clean": _episodes_json(paired.clean, references),
        "levels": [_disturbance_json(each, references) for each in paired.disturbed],
    }


def _episodes_json(
    results: EpisodeResults, references: ReferenceReturns | None
) -> dict[str, Any]:
    raw = {
        "returns": results.returns.tolist(),
        "lengths": results.lengths.tolist(),
        "seeds": results.seeds.tolist(),
    }
    if references is None:
        return raw
    return raw | {"scores": references.score(results.returns).tolist()}


def _disturbance_json(
    results: DisturbanceResults, references: ReferenceReturns | None
) -> dict[str, Any]:
    return {
        "name": results.disturbance.name,
        "kind": results.disturbance.kind,
        "strength": results.disturbance.strength,
        **_episodes_json(results.results, references),
        "disturbed_at": results.disturbed_at,
        **_recovery_json(results.recovery),
    }


def _recovery_json(recovery: Sequence[Recovery] | None) -> dict[str, Any]:
    if recovery is None:
        return dict.fromkeys(RECOVERY_ENTRIES)
    mean, count = _mean_curve([each.distance for each in recovery])
    clean_mean, clean_count = _mean_curve([each.clean_distance for each in recovery])
    return {
        "ended_at": [each.ended_at for each in recovery],
        "survived_knock": [each.survived for each in recovery],
        "alive_after": [each.alive_after for each in recovery],
        "clean_alive_after": [each.clean_alive_after for each in recovery],
        "recovery_steps": [each.steps for each in recovery],
        "distance": {
            "offset": list(range(-STEPS_BEFORE, STEPS_AFTER + 1)),
            "mean": mean,
            "count": count,
            "clean_mean": clean_mean,
            "clean_count": clean_count,
        },
    }


def _mean_curve(
    curves: Sequence[NDArray[np.float64]],
) -> tuple[list[float | None], list[int]]:
    """Mean over the episodes that have a step at each offset, and their number."""
    known = np.ma.masked_invalid(curves)
    return known.mean(0).tolist(), known.count(0).tolist()  # None without a step


def summarize_disturbances(
    evaluations: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Means of each disturbance over the episodes of all checkpoints.

    Args:
        evaluations: see :func:`evaluation_json`; the same disturbances in all.

    Returns:
        A row for each disturbance. Over all pairs of episodes: ``"clean_score"``,
        ``"score"`` and ``"decrease"`` (see :func:`decrease_interval`), and
        ``"disturbed_share"``, the share that the disturbance acted in. Over those
        alone: ``"clean_score_disturbed"``, ``"score_disturbed"``,
        ``"decrease_disturbed"``, the shares alive at its end (``"survived"``) and 100
        steps later (``"survival"``; ``"clean_survival"`` of the undisturbed ones),
        ``"recovered_share"`` and ``"recovery_median"``, steps until back in the data.
        ``None`` where there is nothing to average, or the median is infinite. Where
        evaluations have returns alone, ``"clean_return"``, ``"return"`` and so on.
    """
    rows = []
    measure = "score" if "scores" in evaluations[0]["clean"] else "return"
    for position, first in enumerate(evaluations[0]["levels"]):
        played = [each["levels"][position] for each in evaluations]

        def joined(key: str, played: Sequence[Mapping[str, Any]] = played) -> list[Any]:
            return [value for each in played for value in each[key] or ()]

        key = f"{measure}s"
        clean = np.array(
            [value for each in evaluations for value in each["clean"][key]]
        )
        values = np.array(joined(key))
        hit = np.array([moment is not None for moment in joined("disturbed_at")])
        mean, low, high = mean_interval(values)
        rows.append(
            {
                "name": first["name"],
                "kind": first["kind"],
                "strength": first["strength"],
                f"clean_{measure}": float(clean.mean()),
                measure: mean,
                f"{measure}_low": low,
                f"{measure}_high": high,
                **_decrease("decrease", clean, values),
                "disturbed_share": float(hit.mean()),
                f"clean_{measure}_disturbed": _mean(clean[hit]),
                f"{measure}_disturbed": _mean(values[hit]),
                **_decrease("decrease_disturbed", clean[hit], values[hit]),
                "survived": _share(joined("survived_knock")),
                "survival": _share(joined("alive_after")),
                "clean_survival": _share(joined("clean_alive_after")),
                **_recovered(joined("recovery_steps"), hit),
            }
        )
    return rows


def _decrease(name: str, clean: ArrayLike, scores: ArrayLike) -> dict[str, Any]:
    names = (name, f"{name}_low", f"{name}_high")
    return dict(zip(names, decrease_interval(clean, scores), strict=True))


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if values.size else None


def _share(values: Sequence[bool | None]) -> float | None:
    return _mean(np.array([value for value in values if value is not None]))


def _recovered(
    steps: Sequence[int | None], hit: NDArray[np.bool_]
) -> dict[str, float | None]:
    """Median and share of the disturbed episodes; the others have no steps."""
    if not steps or not hit.any():
        return {"recovery_median": None, "recovered_share": None}
    late = np.array([np.inf if each is None else each for each in steps])[hit]
    median = float(np.median(late))
    return {
        "recovery_median": median if np.isfinite(median) else None,
        "recovered_share": float(np.isfinite(late).mean()),
    }


def robustness_table(title: str, summary: Sequence[Mapping[str, Any]]) -> str:
    """Text table of a summary, see :func:`summarize_disturbances`."""

    def number(value: float | None, digits: int = 1) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    def percent(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.0f} %"

    measure = measure_of(summary[0])
    rows = [
        (
            row["name"],
            number(row[f"clean_{measure}"]),
            number(row[measure]),
            number(row["decrease"]),
            f"[{number(row['decrease_low'])}, {number(row['decrease_high'])}]",
            percent(row["disturbed_share"]),
            percent(row["survival"]),
            percent(row["clean_survival"]),
            percent(row["recovered_share"]),
            number(row["recovery_median"]),
        )
        for row in summary
    ]
    header = ("disturbance", "clean", measure, *COLUMNS)
    lines = [title, *aligned_columns([header, *rows])]
    if unmet := [row["name"] for row in summary if not row["disturbed_share"]]:
        lines.append(
            f"  {', '.join(unmet)}: no episode lasted long enough to meet it, so "
            "that nothing is known about it; windows count steps of an episode."
        )
    return "\n".join(lines)


def aligned_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a text table: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *cells in rows:
        pairs = zip(cells, widths[1:], strict=True)
        aligned = [cell.rjust(width) for cell, width in pairs]
        lines.append("  ".join(["", first.ljust(widths[0]), *aligned]))
    return lines
