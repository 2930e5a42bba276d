"""Text tables: aligned columns, and the scores of a training run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_osr.lab.evaluation.episodes import measure_of

NUM_RECENT = 5  # neighbouring evaluations swing by tens of points: one says little


def run_summary(
    title: str,
    history: Sequence[Mapping[str, Any]],
    best: Mapping[str, Any],
    data_mean: float | None,
    folder: Path,
) -> str:
    """Format the scores, or returns, of the data and of all evaluations.

    The mean leaves out the untrained policy, at step 0. The ``best`` evaluation is
    biased upwards, because its own episodes selected it.
    """
    measure, last = measure_of(best), history[-1]

    def text(row: Mapping[str, Any]) -> str:
        mean, low, high = (row[f"{measure}{end}"] for end in ("", "_low", "_high"))
        return f"{mean:6.1f}" + f"  [{low:.1f}, {high:.1f}]" * bool(low < high)

    trained = [row[measure] for row in history if row["step"]]
    recent = (trained or [last[measure]])[-NUM_RECENT:]
    rows = {
        "data, mean episode": "unknown" if data_mean is None else f"{data_mean:6.1f}",
        "policy, last": text(last),
        f"policy, mean of last {len(recent)}": f"{np.mean(recent):6.1f}",
        "policy, best evaluation": f"{text(best)}  at step {best['step']}",
    }
    scale = "normalised score, 0 random and 100 expert"
    lines = [f"{title}: {scale if measure == 'score' else measure} [95 % interval]"]
    lines += [f"  {label:<25}{value}" for label, value in rows.items()]
    return "\n".join([*lines, f"  {'files':<26}{folder}"])


def aligned_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Format rows as lines, the first column to the left, the others to the right."""
    columns = []
    for number, cells in enumerate(zip(*rows, strict=True)):
        width = max(map(len, cells))
        columns.append([f"{cell:{'>' if number else '<'}{width}}" for cell in cells])
    return ["  ".join(["", *line]) for line in zip(*columns, strict=True)]
