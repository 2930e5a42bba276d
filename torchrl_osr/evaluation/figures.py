"""The figure of a run: its score and its losses over the gradient steps."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError(
        f"figures need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

# Okabe and Ito's palette, which colour-blind readers can tell apart.
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#666666"

PANELS = {
    "loss_qvalue": "TD error (critics)",
    "loss_cql": "conservative term (critics)",
    "loss_recovery": "state recovery (policy)",
    "pred_value": "Q of the data's actions",
}
"""Logged numbers that the figure shows below the score, and what they are called."""


@contextmanager
def whole_picture(path: Path | str) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to; renamed once it is whole.

    Args:
        path: where the picture shall be.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.new")
    try:
        yield beside
        with beside.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def read_scalars(folder: Path | str) -> dict[str, list[tuple[int, float]]]:
    """Read what a TorchRL ``CSVLogger`` wrote, by name.

    A resumed run logs the steps since its checkpoint once more; the later row counts.

    Args:
        folder: the logger's ``scalars`` folder of one phase.

    Returns:
        Step and value pairs, in the order of the steps.
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
    data_score: float | None,
) -> None:
    """Draw the score with its interval, and the losses, over gradient steps.

    Args:
        history: evaluations with ``"step"``, ``"score"``, ``"score_low"`` and
            ``"score_high"``.
        scalars: see :func:`read_scalars`.
        path: the PNG to write.

    Keyword Args:
        title: what was trained on what.
        data_score: mean normalised score of the data's episodes, if it is known.
    """
    panels = [name for name in PANELS if scalars.get(name)]
    figure = Figure(figsize=(9, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, max(len(panels), 1), height_ratios=(2, 1))
    figure.suptitle(title)

    axes = figure.add_subplot(grid[0, :])
    steps = [row["step"] for row in history]
    low, high = ([row[f"score_{end}"] for row in history] for end in ("low", "high"))
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, linewidth=0)
    axes.plot(
        steps, [row["score"] for row in history], "o-", color=BLUE, markersize=4,
        label="policy (mean of the episodes, 95 % interval)",
    )  # fmt: skip
    if data_score is not None:
        label = "data (mean episode)"
        axes.axhline(data_score, color=ORANGE, linestyle="--", label=label)
    axes.set(xlabel="gradient steps", ylabel="normalised score")
    axes.legend(loc="upper left", frameon=False)
    for column, name in enumerate(panels):
        small = figure.add_subplot(grid[1, column])
        small.plot(*zip(*scalars[name], strict=True), color=GREY, linewidth=1)
        small.set_title(PANELS[name], fontsize=9)
        small.tick_params(labelsize=8)
        small.set_xlabel("gradient steps", fontsize=8)
        small.ticklabel_format(axis="x", style="sci", scilimits=(3, 3))
    for each in figure.axes:
        each.spines[["top", "right"]].set_visible(False)
    with whole_picture(path) as beside:
        figure.savefig(beside, dpi=150, format="png")
