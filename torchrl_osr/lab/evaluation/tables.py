"""Text tables of a training run and of its evaluation under disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_osr.lab.evaluation.episodes import measure_of
from torchrl_osr.lab.evaluation.recovery import STEPS_AFTER

NUM_RECENT = 5  # neighbouring evaluations swing by tens of points: one says little


def score_table(
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
        return f"{mean:6.1f}  [{low:.1f}, {high:.1f}]"

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


def robustness_table(title: str, summary: Sequence[Mapping[str, Any]]) -> str:
    """Format a summary, see :func:`summarize_disturbances`, as a text table."""

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.1f}"

    def percent(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.0f} %"

    measure = measure_of(summary[0])
    header = (
        *("disturbance", "clean", measure, "loss %", "[95 %]", "met it"),
        *(f"alive +{STEPS_AFTER}", "(clean)", "back", "steps back"),
    )
    rows = [
        (
            row["name"],
            *(number(row[key]) for key in (f"clean_{measure}", measure, "decrease")),
            f"[{number(row['decrease_low'])}, {number(row['decrease_high'])}]",
            *map(percent, (row["disturbed_share"], row["survival"])),
            *map(percent, (row["clean_survival"], row["recovered_share"])),
            number(row["recovery_median"]),
        )
        for row in summary
    ]
    lines = [title, *aligned_columns([header, *rows])]
    if unmet := [row["name"] for row in summary if not row["disturbed_share"]]:
        lines.append(f"  {', '.join(unmet)}: every episode ended before it came.")
    return "\n".join(lines)


def aligned_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Format rows as lines, the first column to the left, the others to the right."""
    columns = []
    for number, cells in enumerate(zip(*rows, strict=True)):
        width = max(map(len, cells))
        columns.append([f"{cell:{'>' if number else '<'}{width}}" for cell in cells])
    return ["  ".join(["", *line]) for line in zip(*columns, strict=True)]
