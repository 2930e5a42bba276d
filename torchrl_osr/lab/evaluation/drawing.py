"""Figures that need no display and are written whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_osr._extras import needed_by
from torchrl_osr._files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers can tell apart.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"

IN_WORDS = {"score": "normalised score", "return": "return"}
"""What figures call the measure of an episode."""


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Matplotlib figure, ``width`` x ``height`` inches, that draws in memory."""
    with needed_by("figures need", "train"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path | str, *, dpi: int = 150) -> None:
    """Write a figure as PNG; a file of that name is replaced once it is whole."""
    with whole_file(Path(path)) as file:
        figure.savefig(file, dpi=dpi, format="png")
