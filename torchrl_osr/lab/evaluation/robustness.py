"""Episodes with and without disturbances, in pairs: same policy, same start state.

How it is measured is in ``docs/robustness.md``. Shapes: ``E`` pairs of episodes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    measure_recovery,
)
from torchrl_osr.lab.evaluation.statistics import decrease_interval, mean_interval

TRANSIENT = ("knock", "push", "start")
"""Kinds of disturbance that end, so that there is something to recover from."""

ENTRIES = (
    *("ended_at", "survived_knock", "alive_after", "clean_alive_after"),
    "recovery_steps",
)
"""What is known of each episode after a disturbance that ends."""


@dataclass(frozen=True)
class Disturbance:
    """One kind of disturbance at one strength.

    Attributes:
        name: unique in its suite.
        kind: of the disturbance; those of :data:`TRANSIENT` end.
        strength: in the unit of its kind.
        wrap: puts the disturbance around an environment. Default: nothing.
        policy: an attacked one, instead of the evaluated one. Default: none.
    """

    name: str
    kind: str
    strength: float
    wrap: Wrap | None = None
    policy: Policy | None = None


def evaluate_paired(
    policy: Policy,
    env_id: str,
    disturbances: Sequence[Disturbance],
    distance: DataDistance,
    *,
    num_episodes: int = 10,
    seed: int = 0,
    references: ReferenceReturns | None = None,
    advance: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Play clean episodes once, and the same episodes under each disturbance.

    Episodes of a pair have the same seed, hence the same start state, and the policy
    is called with batches of one size: until the disturbance acts they are equal, bit
    for bit. Warns if the environment ignores its seed.

    Args:
        policy: to be evaluated, on the CPU.
        env_id: a Gymnasium id, ``"Hopper-v5"`` for instance.
        disturbances: of one suite.
        distance: to the data that the policy was trained on.

    Keyword Args:
        num_episodes: ``E``. Default 10.
        seed: the episodes are seeded ``seed, seed + 1, ...``. Default 0.
        references: what returns are normalised by. Default: no scores.
        advance: called after the clean episodes and after each disturbance.

    Returns:
        JSON-compatible. ``"clean"``: lists ``"returns"``, ``"lengths"``, ``"seeds"``
        and, with references, ``"scores"``, one entry an episode. ``"levels"``: the same
        for each disturbance, with ``"name"``, ``"kind"``, ``"strength"``, the step at
        which each episode was ``"disturbed_at"`` (``None``: it ended before), and the
        entries of :func:`~torchrl_osr.lab.evaluation.recovery.measure_recovery`, which
        are ``None`` if the disturbance does not end.
    """

    def play(policy: Policy, wrap: Wrap | None) -> tuple[EpisodeResults, Recorder]:
        evaluator = EpisodeEvaluator(
            env_id, num_episodes=num_episodes, seed=seed, wrap=wrap, fixed_batch=True
        )
        recorder = Recorder(num_episodes)
        with closing(evaluator):
            if wrap is None:
                start, again = (
                    evaluator.environments[0].reset(seed=seed)[0] for _ in range(2)
                )
                if not np.array_equal(start, again):
                    warnings.warn(
                        f"{env_id} ignores its seed: two resets with seed {seed} give "
                        "different observations, and the pairs are not pairs.",
                        stacklevel=3,
                    )
            results = evaluator(policy, recorder)
        advance()
        return results, recorder

    clean, undisturbed = play(policy, None)
    levels = []
    for each in disturbances:
        results, recorder = play(each.policy or policy, each.wrap)
        moments: list[int | None] = [0] * num_episodes  # an attack: in every step
        if each.policy is None:
            blocks = [episode.disturbance() for episode in recorder.trajectories]
            # A disturbance of the start state counts as step 0.
            moments = [
                None if block is None else max(block[0] - 1, 0) for block in blocks
            ]
        recovery = None
        if each.kind in TRANSIENT:
            pairs = zip(recorder.trajectories, undisturbed.trajectories, strict=True)
            recovery = [measure_recovery(*pair, distance) for pair in pairs]
        levels.append(
            {"name": each.name, "kind": each.kind, "strength": each.strength}
            | _episodes_json(results, references)
            | {"disturbed_at": moments}
            | _recovery_json(recovery)
        )
    return {"clean": _episodes_json(clean, references), "levels": levels}


def impossible_disturbances(
    env_id: str, disturbances: Sequence[Disturbance]
) -> dict[str, str]:
    """Names of those that need what the environment lacks, and why."""
    from torchrl_osr.lab.envs import NotPossible  # needs MuJoCo, and the rest does not

    reasons = {}
    for each in disturbances:
        try:
            EpisodeEvaluator(env_id, num_episodes=1, wrap=each.wrap).close()
        except NotPossible as error:
            reasons[each.name] = str(error)
    return reasons


def _episodes_json(
    results: EpisodeResults, references: ReferenceReturns | None
) -> dict[str, Any]:
    names = ("returns", "lengths", "seeds")
    raw = {name: getattr(results, name).tolist() for name in names}
    if references is None:
        return raw
    return raw | {"scores": references.score(results.returns).tolist()}


def _recovery_json(
    recovery: Sequence[Mapping[str, Any] | None] | None,
) -> dict[str, Any]:
    """Entries of :func:`measure_recovery`, a list each, and mean distances."""
    if recovery is None:
        return dict.fromkeys([*ENTRIES, "distance"])
    lists = {key: [each and each[key] for each in recovery] for key in ENTRIES}
    nowhere = np.full(STEPS_BEFORE + 1 + STEPS_AFTER, np.nan)
    curves: dict[str, Any] = {"offset": list(range(-STEPS_BEFORE, STEPS_AFTER + 1))}
    for prefix in ("", "clean_"):
        rows = [each[f"{prefix}distance"] if each else nowhere for each in recovery]
        known = np.ma.masked_invalid(rows)
        curves[f"{prefix}mean"] = known.mean(0).tolist()  # None without a step
        curves[f"{prefix}count"] = known.count(0).tolist()
    return lists | {"distance": curves}


def summarize_disturbances(
    evaluations: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Means of each disturbance over the episodes of all checkpoints.

    Args:
        evaluations: see :func:`evaluate_paired`; the same disturbances in all.

    Returns:
        A row for each disturbance. Over all pairs of episodes: ``"clean_score"``,
        ``"score"`` and ``"decrease"`` (see
        :func:`~torchrl_osr.lab.evaluation.statistics.decrease_interval`), and
        ``"disturbed_share"``, the share that the disturbance acted in. Over those
        alone: ``"clean_score_disturbed"``, ``"score_disturbed"``,
        ``"decrease_disturbed"``, the shares alive at its end (``"survived"``) and 100
        steps later (``"survival"``; ``"clean_survival"`` of the undisturbed ones),
        ``"recovered_share"`` and ``"recovery_median"``, steps until back in the data.
        ``None`` where there is nothing to average, no episode met the disturbance, or
        the median is infinite. Where
        evaluations have returns alone, ``"clean_return"``, ``"return"`` and so on.
    """
    rows = []
    measure = "score" if "scores" in evaluations[0]["clean"] else "return"
    for position, first in enumerate(evaluations[0]["levels"]):
        levels = [each["levels"][position] for each in evaluations]
        entries = {
            key: [value for level in levels for value in level[key] or ()]
            for key in first
            if isinstance(first[key], list)
        }
        clean = np.concatenate([each["clean"][f"{measure}s"] for each in evaluations])
        values = np.array(entries[f"{measure}s"])
        hit = np.array([moment is not None for moment in entries["disturbed_at"]])
        mean, low, high = mean_interval(values)
        row = {key: first[key] for key in ("name", "kind", "strength")}
        row |= {f"clean_{measure}": float(clean.mean()), measure: mean}
        row |= {f"{measure}_low": low, f"{measure}_high": high}
        met = slice(None) if hit.any() else slice(0)  # an unmet one has no loss
        row |= _decrease("decrease", clean[met], values[met])
        row |= {
            "disturbed_share": float(hit.mean()),
            f"clean_{measure}_disturbed": _mean(clean[hit]),
            f"{measure}_disturbed": _mean(values[hit]),
        }
        row |= _decrease("decrease_disturbed", clean[hit], values[hit])
        for name, key in (
            ("survived", "survived_knock"),
            ("survival", "alive_after"),
            ("clean_survival", "clean_alive_after"),
        ):
            known = [value for value in entries.get(key, ()) if value is not None]
            row[name] = _mean(np.array(known))
        median = share = None
        if "recovery_steps" in entries and hit.any():
            steps = entries["recovery_steps"]
            late = np.array([np.inf if each is None else each for each in steps])[hit]
            share = float(np.isfinite(late).mean())
            median = float(np.median(late)) if np.isfinite(np.median(late)) else None
        rows.append(row | {"recovery_median": median, "recovered_share": share})
    return rows


def _decrease(name: str, clean: NDArray[Any], values: NDArray[Any]) -> dict[str, Any]:
    names = (name, f"{name}_low", f"{name}_high")
    return dict(zip(names, decrease_interval(clean, values), strict=True))


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if values.size else None


def robustness_table(title: str, summary: Sequence[Mapping[str, Any]]) -> str:
    """Text table of a summary, see :func:`summarize_disturbances`."""

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.1f}"

    def percent(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.0f} %"

    measure, rows = measure_of(summary[0]), []
    for row in summary:
        low, high = (number(row[f"decrease_{end}"]) for end in ("low", "high"))
        cells = {
            "disturbance": row["name"],
            "clean": number(row[f"clean_{measure}"]),
            measure: number(row[measure]),
            "loss %": number(row["decrease"]),
            "[95 %]": f"[{low}, {high}]",
            "met it": percent(row["disturbed_share"]),
            f"alive +{STEPS_AFTER}": percent(row["survival"]),
            "(clean)": percent(row["clean_survival"]),
            "back": percent(row["recovered_share"]),
            "steps back": number(row["recovery_median"]),
        }
        rows.append(tuple(cells.values()))
    lines = [title, *aligned_columns([tuple(cells), *rows])]
    if unmet := [row["name"] for row in summary if not row["disturbed_share"]]:
        lines.append(f"  {', '.join(unmet)}: every episode ended before it came.")
    return "\n".join(lines)


def aligned_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a text table: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            ["", first.ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        )
        for first, *cells in rows
    ]
