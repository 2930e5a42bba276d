"""Figures of training runs."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchrl_osr._files import whole_file
from torchrl_osr.lab.evaluation.episodes import measure_of

# Okabe and Ito's palette, which colour-blind readers can distinguish.
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#666666"

IN_WORDS = {"score": "normalised score", "return": "return"}

PANELS = {
    "loss_qvalue": "loss of the critics",
    "loss_cql": "conservative term (critics)",
    "recovery_kl": "state recovery (policy)",
    "recovery_nll": "recovery to the data's actions (policy)",
    "recovery_error": "recovery to the data's actions (policy)",
    "recovery_gap": "state recovery (critics)",
    "pred_value": "Q of the data's actions",
}
"""Logged scalars below the learning curve, and their titles."""


def save_figure(figure: Figure, path: Path | str, *, dpi: int = 150) -> None:
    """Write a figure as PNG; a file of that name is replaced once it is whole."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    with whole_file(Path(path)) as file:
        figure.savefig(file, dpi=dpi, format="png")


def learning_curve(
    history: Sequence[Mapping[str, Any]],
    scalars: Mapping[str, Sequence[tuple[int, float]]],
    path: Path | str,
    *,
    title: str,
    data_mean: float | None,
) -> None:
    """Draw the score, or return, of the evaluations, and the losses."""
    panels = [name for name in PANELS if scalars.get(name)]
    panels = panels or [name for name in scalars if name.startswith("loss_")]
    ratios = (2, 1) if history else (1,)
    figure = Figure(figsize=(9, 2.1 * sum(ratios)), layout="constrained")
    grid = figure.add_gridspec(len(ratios), max(len(panels), 1), height_ratios=ratios)
    figure.suptitle(title)
    if history:
        axes = figure.add_subplot(grid[0, :])
        measure, steps = measure_of(history[0]), [row["step"] for row in history]
        mean, low, high = (
            [row[f"{measure}{end}"] for row in history] for end in ("", "_low", "_high")
        )
        axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, linewidth=0)
        label = "policy (mean of the episodes, 95 % interval)"
        axes.plot(steps, mean, "o-", color=BLUE, markersize=4, label=label)
        if data_mean is not None:
            label = "data (mean episode)"
            axes.axhline(data_mean, color=ORANGE, linestyle="--", label=label)
        axes.set(xlabel="updates", ylabel=IN_WORDS[measure])
        # Outside: inside it would cover the curve.
        figure.legend(loc="outside upper right", frameon=False, fontsize=8)
    for column, name in enumerate(panels):
        small = figure.add_subplot(grid[-1, column])
        small.plot(*zip(*scalars[name], strict=True), color=GREY, linewidth=1)
        small.set_title(PANELS.get(name, name), fontsize=9)
        small.tick_params(labelsize=8)
        small.set_xlabel("updates", fontsize=8)
        small.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
    save_figure(figure, path)


def read_scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Read steps and values of each scalar that TorchRL's ``CSVLogger`` wrote.

    A resumed run logs the steps since its checkpoint once more; the later row counts.
    """
    scalars = {}
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="") as file:
            rows = {int(step): float(value) for step, value in csv.reader(file)}
        scalars[path.stem] = sorted(rows.items())
    return scalars
