"""What a run says at its end: the table of its scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

NUM_RECENT = 5
"""Evaluations in the mean of the last ones.

Scores of neighbouring evaluations swing by tens of points, so one of them says little.
"""


def recent_score(history: Sequence[Mapping[str, Any]]) -> float:
    """Return the mean score of the last :data:`NUM_RECENT` evaluations."""
    return float(np.mean([row["score"] for row in history[-NUM_RECENT:]]))


def score_table(
    title: str,
    history: Sequence[Mapping[str, Any]],
    best: Mapping[str, Any],
    data_score: float | None,
    folder: Path,
) -> str:
    """Return the table of data's and policy's scores.

    Args:
        title: what was trained on what.
        history: all evaluations with their ``"step"``, see
            :func:`~torchrl_osr.evaluation.episodes.summarize`.
        best: the best of them; chosen by its own episodes, hence optimistic.
        data_score: mean normalised score of the data's episodes, if it is known.
        folder: where the run's files are.
    """

    def with_interval(row: Mapping[str, Any]) -> str:
        return f"{row['score']:6.1f}  [{row['score_low']:.1f}, {row['score_high']:.1f}]"

    known = "unknown" if data_score is None else f"{data_score:6.1f}"
    rows = [
        ("data, mean episode", known),
        ("policy, last", with_interval(history[-1])),
        (
            f"policy, mean of last {min(NUM_RECENT, len(history))}",
            f"{recent_score(history):6.1f}",
        ),
        ("policy, best evaluation", f"{with_interval(best)}  at step {best['step']}"),
    ]
    if "success_rate" in history[-1]:
        last = history[-1]
        rate, low, high = (
            100 * last[name] for name in ("success_rate", "success_low", "success_high")
        )
        said = f"{rate:6.1f}  [{low:.1f}, {high:.1f}]  % of {len(last['successes'])}"
        rows.insert(2, ("policy, last, success", f"{said} episodes, Wilson interval"))
    lines = [f"{title}: normalised score, 0 random and 100 expert [95 % interval]"]
    lines += [f"  {label:<25}{value}" for label, value in rows]
    return "\n".join([*lines, f"  {'files':<26}{folder}"])
