"""The report's figure of differences: every method less the reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_osr.report.figures import (
    GREY,
    Style,
    Styles,
    grid,
    grid_sideways,
    legend,
    plain,
    save,
)
from torchrl_osr.report.paired import Comparison
from torchrl_osr.report.quantities import Quantity

if TYPE_CHECKING:  # figures says what to install where there is no Matplotlib
    from matplotlib.axes import Axes

ROW = 0.17
"""Of a method on a data set, in inches."""


def draw_differences(
    found: Sequence[Comparison],
    wanted: Sequence[Quantity],
    styles: Styles,
    reference: str,
    path: Path,
) -> Path:
    """Draw differences with their intervals, a panel a quantity.

    Filled markers: the interval leaves out 0. Hollow ones: not told apart. Pale: the
    interval is over episodes, for want of seeds.

    Args:
        found: the comparisons; those that are not paired are not drawn.
        wanted: the quantities, in the order of the panels.
        styles: of the methods.
        reference: the method that the others are compared with.
        path: the PNG to write.
    """
    paired = [each for each in found if each.difference is not None]
    lines = _lines(paired, list(styles))
    height = 0.7 + ROW * (max(lines.values()) + 2)
    columns = min(3, len(wanted))
    figure, panels = grid(len(wanted), columns=columns, height=height, sharey=True)
    for axes, quantity in zip(panels, wanted, strict=True):
        axes.axvline(0, color=GREY, linewidth=1)
        for each in paired:
            if each.quantity.name == quantity.name:
                _mark(axes, each, styles[each.method], lines[each.data, each.method])
        better = "less is better" if quantity.sign < 0 else "more is better"
        axes.set_title(f"{plain(quantity.name)}\n({better})", fontsize=10)
        axes.set_xlabel(f"points, less {plain(reference)}", fontsize=9)
        grid_sideways(axes)
    data_sets = dict.fromkeys(data for data, _ in lines)
    middle = [np.mean([lines[key] for key in lines if key[0] == d]) for d in data_sets]
    names = [plain(data.replace(" ", "\n", 1)) for data in data_sets]
    panels[0].set_yticks(middle, names)
    panels[0].set_ylim(max(lines.values()) + 1, -1)
    drawn = {method for _, method in lines}
    legend(figure, {m: styles[m] for m in styles if m in drawn}, marker=True)
    return save(figure, path)


def _mark(axes: Axes, each: Comparison, style: Style, y: int) -> None:
    """Draw one difference."""
    assert each.difference is not None
    mean, low, high, over = each.difference
    pale = 0.45 if over == "episodes" else 1.0
    face = "white" if each.verdict == "not told apart" else style.color
    axes.hlines(y, low, high, color=style.color, linewidth=1.4, alpha=pale)
    axes.plot(
        mean, y, style.marker, color=style.color, markersize=5, alpha=pale,
        markerfacecolor=face,
    )  # fmt: skip


def _lines(
    paired: Sequence[Comparison], methods: Sequence[str]
) -> dict[tuple[str, str], int]:
    """Return the line of each data set and method, with one of air between data."""
    there = {(each.data, each.method) for each in paired}
    lines: dict[tuple[str, str], int] = {}
    for air, data in enumerate(dict.fromkeys(each.data for each in paired)):
        for method in methods:
            if (data, method) in there:
                lines[data, method] = len(lines) + air
    return lines
