"""What an evaluation under disturbances says: its JSON and its summary.

Shapes: ``E`` pairs of episodes, over all checkpoints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_osr.data import normalized_score
from torchrl_osr.evaluation.episodes import EpisodeResults
from torchrl_osr.evaluation.recovery import STEPS_AFTER, STEPS_BEFORE
from torchrl_osr.evaluation.robustness import LevelResults, PairedResults
from torchrl_osr.evaluation.statistics import mean_interval

RECOVERY_ENTRIES = (
    "ended_at", "survived_knock", "alive_after", "clean_alive_after", "recovery_steps",
    "distance",
)  # fmt: skip
"""Of a level's results, ``None`` for a disturbance that does not end."""


def decrease_interval(
    clean: ArrayLike,
    disturbed: ArrayLike,
    *,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> tuple[float | None, float | None, float | None]:
    """Return the decrease of the mean in percent, and its paired-bootstrap interval.

    Pairs of episodes are resampled together, so that what both have in common does not
    widen the interval.

    Args:
        clean, disturbed: normalised scores of the pairs, ``[E]`` each.

    Keyword Args:
        confidence: coverage of the interval. Default 0.95.
        num_resamples: bootstrap resamples. Default 2000.
        seed: of the resampling. Default 0.

    Returns:
        ``100 (1 - mean(disturbed) / mean(clean))``, lower and upper end. All three are
        ``None`` where the clean mean is not above 0: there is nothing to lose; the ends
        alone where that is so in a resample.

    Raises:
        ValueError: if there are not two pairs or more, or a score is not finite.

    Examples:
        >>> decrease_interval([40.0, 60.0], [20.0, 30.0])
        (50.0, 50.0, 50.0)
    """
    pairs = np.stack([np.asarray(clean, float), np.asarray(disturbed, float)])
    if pairs.ndim != 2 or pairs.shape[1] < 2 or not np.isfinite(pairs).all():
        raise ValueError(
            f"decrease_interval needs two finite pairs or more, got {pairs.tolist()}."
        )
    means = pairs.mean(1)
    if means[0] <= 0:
        return None, None, None
    rng = np.random.default_rng(seed)
    rows = rng.integers(pairs.shape[1], size=(num_resamples, pairs.shape[1]))
    resampled = pairs[:, rows].mean(-1)
    decrease = float(100 * (1 - means[1] / means[0]))
    if (resampled[0] <= 0).any():
        return decrease, None, None
    tail = 50 * (1 - confidence)
    low, high = np.percentile(
        100 * (1 - resampled[1] / resampled[0]), [tail, 100 - tail]
    )
    return decrease, float(low), float(high)


def evaluation_json(step: int, paired: PairedResults, env_name: str) -> dict[str, Any]:
    """Return the raw results of one checkpoint, JSON-compatible.

    Args:
        step: gradient steps of the checkpoint.
        paired: its episodes.
        env_name: short name with reference returns, ``"hopper"`` for instance.
    """
    return {
        "step": step,
        "clean": _episodes(paired.clean, env_name),
        "levels": [_level(results, env_name) for results in paired.levels],
    }


def _episodes(results: EpisodeResults, env_name: str) -> dict[str, Any]:
    return {
        "returns": results.returns.tolist(),
        "lengths": results.lengths.tolist(),
        "seeds": results.seeds.tolist(),
        "scores": normalized_score(env_name, results.returns).tolist(),
    }


def _level(results: LevelResults, env_name: str) -> dict[str, Any]:
    level, recovery = results.level, results.recovery
    entries = {
        "name": level.name,
        "kind": level.kind,
        "strength": level.strength,
        **_episodes(results.results, env_name),
        "disturbed_at": results.disturbed_at,
    }
    if recovery is None:
        return entries | dict.fromkeys(RECOVERY_ENTRIES)
    distance, clean = recovery.distance, recovery.clean_distance
    curves = {
        "offset": list(range(-STEPS_BEFORE, STEPS_AFTER + 1)),
        "mean": distance.mean(),
        "count": distance.count.tolist(),
        "clean_mean": clean.mean(),
        "clean_count": clean.count.tolist(),
    }
    values = (
        recovery.ended_at, recovery.survived, recovery.alive_after,
        recovery.clean_alive_after, recovery.steps, curves,
    )  # fmt: skip
    return entries | dict(zip(RECOVERY_ENTRIES, values, strict=True))


def summarize_levels(evaluations: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each level, over the episodes of all checkpoints.

    Args:
        evaluations: see :func:`evaluation_json`; the same levels in all.

    Returns:
        ``"name"``, ``"kind"``, ``"strength"``, ``"clean_score"`` and ``"score"`` (means
        over all pairs of episodes), ``"score_low"``, ``"score_high"``, ``"decrease"``
        with its interval ``"decrease_low"``, ``"decrease_high"``; ``"disturbed_share"``
        of the episodes that lived to see the disturbance; and over those alone
        ``"clean_score_disturbed"``, ``"score_disturbed"``, ``"decrease_disturbed"``
        with interval, ``"survived"`` (share alive at its end), ``"survival"`` (share
        alive 100 steps later), ``"clean_survival"`` (of the undisturbed ones of the
        pairs, at the same step), ``"recovered_share"`` and ``"recovery_median"`` (those
        who never came back count as infinitely late). ``None`` where there is nothing
        to average, or the median is infinite.
    """
    rows = []
    for position, level in enumerate(evaluations[0]["levels"]):
        levels = [each["levels"][position] for each in evaluations]

        def joined(key: str, levels: Sequence[Mapping[str, Any]] = levels) -> list[Any]:
            return [value for each in levels for value in each[key] or ()]

        clean = np.array([s for each in evaluations for s in each["clean"]["scores"]])
        scores = np.array(joined("scores"))
        hit = np.array([moment is not None for moment in joined("disturbed_at")])
        score, low, high = mean_interval(scores)
        rows.append(
            {
                "name": level["name"],
                "kind": level["kind"],
                "strength": level["strength"],
                "clean_score": float(clean.mean()),
                "score": score,
                "score_low": low,
                "score_high": high,
                **_decrease("decrease", clean, scores),
                "disturbed_share": float(hit.mean()),
                "clean_score_disturbed": _mean(clean[hit]),
                "score_disturbed": _mean(scores[hit]),
                **_decrease("decrease_disturbed", clean[hit], scores[hit]),
                "survived": _share(joined("survived_knock")),
                "survival": _share(joined("alive_after")),
                "clean_survival": _share(joined("clean_alive_after")),
                **_recovered(joined("recovery_steps"), hit),
            }
        )
    return rows


def _decrease(name: str, clean: ArrayLike, scores: ArrayLike) -> dict[str, Any]:
    enough = np.size(clean) >= 2
    values = decrease_interval(clean, scores) if enough else (None,) * 3
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if values.size else None


def _share(values: Sequence[bool | None]) -> float | None:
    return _mean(np.array([value for value in values if value is not None]))


def _recovered(
    steps: Sequence[int | None], hit: NDArray[np.bool_]
) -> dict[str, float | None]:
    """Return median and share; who was not disturbed has nothing to recover from."""
    if not steps or not hit.any():
        return {"recovery_median": None, "recovered_share": None}
    late = np.array([np.inf if each is None else each for each in steps])[hit]
    median = float(np.median(late))
    return {
        "recovery_median": median if np.isfinite(median) else None,
        "recovered_share": float(np.isfinite(late).mean()),
    }
