"""Table of a training run's scores, and the scalars that it logged."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_osr.lab.evaluation.episodes import measure_of

NUM_RECENT = 5
"""Evaluations in the mean of the last ones.

Scores of neighbouring evaluations swing by tens of points, so one of them says little.
"""


def score_table(
    title: str,
    history: Sequence[Mapping[str, Any]],
    best: Mapping[str, Any],
    data_mean: float | None,
    folder: Path,
) -> str:
    """Text table of the data's and the policy's scores, or returns without scores.

    The evaluation of the untrained policy, at step 0, is in no mean.

    Args:
        title: name of the run.
        history: all evaluations with their ``"step"``, see
            :func:`~torchrl_osr.lab.evaluation.summarize`.
        best: the best of them; chosen by its own episodes, hence optimistic.
        data_mean: mean score, or return, of the data's episodes, if known.
        folder: where the run's files are.
    """
    measure, last = measure_of(best), history[-1]

    def with_interval(row: Mapping[str, Any], name: str, factor: float = 1) -> str:
        mean, low, high = (
            factor * row[f"{name}{end}"] for end in ("", "_low", "_high")
        )
        return f"{mean:6.1f}  [{low:.1f}, {high:.1f}]"

    known = "unknown" if data_mean is None else f"{data_mean:6.1f}"
    trained = [row[measure] for row in history if row["step"]]
    recent = (trained or [last[measure]])[-NUM_RECENT:]
    rows = [
        ("data, mean episode", known),
        ("policy, last", with_interval(last, measure)),
    ]
    if "success_rate" in last:
        rate = {f"rate{end}": last[f"success{old}"] for end, old in RATES.items()}
        episodes = f"  % of {len(last['successes'])} episodes, Wilson interval"
        rows.append(
            ("policy, last, success", with_interval(rate, "rate", 100) + episodes)
        )
    rows += [
        (f"policy, mean of last {len(recent)}", f"{np.mean(recent):6.1f}"),
        (
            "policy, best evaluation",
            f"{with_interval(best, measure)}  at step {best['step']}",
        ),
    ]
    scale = (
        "normalised score, 0 random and 100 expert" if measure == "score" else measure
    )
    lines = [f"{title}: {scale} [95 % interval]"]
    lines += [f"  {label:<25}{value}" for label, value in rows]
    return "\n".join([*lines, f"  {'files':<26}{folder}"])


RATES = {"": "_rate", "_low": "_low", "_high": "_high"}


def read_scalars(folder: Path | str) -> dict[str, list[tuple[int, float]]]:
    """Step and value pairs that a TorchRL ``CSVLogger`` wrote, by name.

    A resumed run logs the steps since its checkpoint once more; the later row counts.

    Args:
        folder: the logger's ``scalars`` folder of one phase.
    """
    scalars = {}
    for path in sorted(Path(folder).glob("*.csv")):
        with path.open(newline="") as file:
            rows = {int(step): float(value) for step, value in csv.reader(file)}
        scalars[path.stem] = sorted(rows.items())
    return scalars
