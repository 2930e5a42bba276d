"""Summary of a training run at its end: table of scores and learning curve."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_osr.lab.evaluation.drawing import (
    BLUE,
    GREY,
    IN_WORDS,
    ORANGE,
    new_figure,
    save_figure,
)
from torchrl_osr.lab.evaluation.episodes import measure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NUM_RECENT = 5
"""Evaluations in the mean of the last ones.

Scores of neighbouring evaluations swing by tens of points, so one of them says little.
"""

PANELS = {
    "loss_qvalue": "TD error (critics)",
    "loss_cql": "conservative term (critics)",
    "recovery_kl": "state recovery (policy)",
    "recovery_nll": "recovery to the data's actions (policy)",
    "pred_value": "Q of the data's actions",
}
"""Logged scalars below the score, and their titles."""


def score_table(
    title: str,
    history: Sequence[Mapping[str, Any]],
    best: Mapping[str, Any],
    data_mean: float | None,
    folder: Path,
) -> str:
    """Text table of the data's and the policy's scores, or returns without scores.

    Args:
        title: what was trained on what.
        history: all evaluations with their ``"step"``, see
            :func:`~torchrl_osr.lab.evaluation.summarize`.
        best: the best of them; chosen by its own episodes, hence optimistic.
        data_mean: mean score, or return, of the data's episodes, if known.
        folder: where the run's files are.
    """
    measure = measure_of(best)

    def with_interval(row: Mapping[str, Any]) -> str:
        mean, low, high = (row[f"{measure}{end}"] for end in ("", "_low", "_high"))
        return f"{mean:6.1f}  [{low:.1f}, {high:.1f}]"

    known = "unknown" if data_mean is None else f"{data_mean:6.1f}"
    recent = [row[measure] for row in history[-NUM_RECENT:]]
    rows = [
        ("data, mean episode", known),
        ("policy, last", with_interval(history[-1])),
        (f"policy, mean of last {len(recent)}", f"{np.mean(recent):6.1f}"),
        ("policy, best evaluation", f"{with_interval(best)}  at step {best['step']}"),
    ]
    if "success_rate" in history[-1]:
        last = history[-1]
        rate, low, high = (
            100 * last[name] for name in ("success_rate", "success_low", "success_high")
        )
        said = f"{rate:6.1f}  [{low:.1f}, {high:.1f}]  % of {len(last['successes'])}"
        rows.insert(2, ("policy, last, success", f"{said} episodes, Wilson interval"))
    scale = ", 0 random and 100 expert" if measure == "score" else ""
    lines = [f"{title}: {IN_WORDS[measure]}{scale} [95 % interval]"]
    lines += [f"  {label:<25}{value}" for label, value in rows]
    return "\n".join([*lines, f"  {'files':<26}{folder}"])


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


def learning_curve(
    history: Sequence[Mapping[str, Any]],
    scalars: Mapping[str, Sequence[tuple[int, float]]],
    path: Path | str,
    *,
    title: str,
    data_mean: float | None,
) -> None:
    """Draw the score, or return, with its interval, and the losses.

    Args:
        history: see :func:`score_table`; without any the losses alone are drawn.
        scalars: see :func:`read_scalars`.
        path: the PNG to write.

    Keyword Args:
        title, data_mean: see :func:`score_table`.
    """
    panels = [name for name in PANELS if scalars.get(name)]
    ratios = (2, 1) if history else (1,)
    figure = new_figure(9, 2.1 * sum(ratios), layout="constrained")
    grid = figure.add_gridspec(len(ratios), max(len(panels), 1), height_ratios=ratios)
    figure.suptitle(title)
    if history:
        _draw_scores(figure.add_subplot(grid[0, :]), history, data_mean)
    for column, name in enumerate(panels):
        small = figure.add_subplot(grid[-1, column])
        small.plot(*zip(*scalars[name], strict=True), color=GREY, linewidth=1)
        small.set_title(PANELS[name], fontsize=9)
        small.tick_params(labelsize=8)
        small.set_xlabel("gradient steps", fontsize=8)
        small.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
    for each in figure.axes:
        each.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def _draw_scores(
    axes: Axes, history: Sequence[Mapping[str, Any]], data_mean: float | None
) -> None:
    steps = [row["step"] for row in history]
    measure = measure_of(history[0])
    low, high = (
        [row[f"{measure}_{end}"] for row in history] for end in ("low", "high")
    )
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, linewidth=0)
    axes.plot(
        steps, [row[measure] for row in history], "o-", color=BLUE, markersize=4,
        label="policy (mean of the episodes, 95 % interval)",
    )  # fmt: skip
    if data_mean is not None:
        label = "data (mean episode)"
        axes.axhline(data_mean, color=ORANGE, linestyle="--", label=label)
    axes.set(xlabel="gradient steps", ylabel=IN_WORDS[measure])
    axes.legend(loc="upper left", frameon=False)
