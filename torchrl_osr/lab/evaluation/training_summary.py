"""Table of a training run's scores, and the scalars that it logged."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_osr.lab.evaluation.episodes import measure_of

NUM_RECENT = 5  # neighbouring evaluations swing by tens of points: one says little


def score_table(
    title: str,
    history: Sequence[Mapping[str, Any]],
    best: Mapping[str, Any],
    data_mean: float | None,
    folder: Path,
) -> str:
    """Format the scores, or returns, of the data and of all evaluations as a table.

    The mean leaves out the untrained policy, at step 0. The ``best`` evaluation is
    chosen by its own episodes, hence optimistic.
    """
    measure, last = measure_of(best), history[-1]

    def text(mean: float, low: float, high: float) -> str:
        return f"{mean:6.1f}  [{low:.1f}, {high:.1f}]"

    ends = (measure, f"{measure}_low", f"{measure}_high")
    trained = [row[measure] for row in history if row["step"]]
    recent = (trained or [last[measure]])[-NUM_RECENT:]
    rows = {
        "data, mean episode": "unknown" if data_mean is None else f"{data_mean:6.1f}",
        "policy, last": text(*(last[key] for key in ends)),
    }
    if "success_rate" in last:
        rate = (100 * last[f"success_{end}"] for end in ("rate", "low", "high"))
        number = f"  % of {len(last['successes'])} episodes, Wilson interval"
        rows["policy, last, success"] = text(*rate) + number
    rows[f"policy, mean of last {len(recent)}"] = f"{np.mean(recent):6.1f}"
    found = f"{text(*(best[key] for key in ends))}  at step {best['step']}"
    rows["policy, best evaluation"] = found
    scale = "normalised score, 0 random and 100 expert"
    lines = [f"{title}: {scale if measure == 'score' else measure} [95 % interval]"]
    lines += [f"  {label:<25}{value}" for label, value in rows.items()]
    return "\n".join([*lines, f"  {'files':<26}{folder}"])


def read_scalars(folder: Path | str) -> dict[str, list[tuple[int, float]]]:
    """Read steps and values from a ``scalars`` folder of TorchRL's ``CSVLogger``.

    A resumed run logs the steps since its checkpoint once more; the later row counts.
    """
    scalars = {}
    for path in sorted(Path(folder).glob("*.csv")):
        with path.open(newline="") as file:
            rows = {int(step): float(value) for step, value in csv.reader(file)}
        scalars[path.stem] = sorted(rows.items())
    return scalars
