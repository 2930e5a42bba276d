"""The report's figure of differences: every method less the reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_osr.report.figures import GREY, Styles, grid, legend, plain, save
from torchrl_osr.report.paired import Comparison
from torchrl_osr.report.quantities import Quantity

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
            if each.quantity.name == quantity.name and each.difference is not None:
                mean, low, high, over = each.difference
                style = styles[each.method]
                told = each.verdict != "not told apart"
                y = lines[each.data, each.method]
                pale = 0.45 if over == "episodes" else 1.0
                axes.hlines(y, low, high, color=style.color, linewidth=1.4, alpha=pale)
                axes.plot(
                    mean, y, style.marker, color=style.color, markersize=5, alpha=pale,
                    markerfacecolor=style.color if told else "white",
                )  # fmt: skip
        better = "less is better" if quantity.sign < 0 else "more is better"
        axes.set_title(f"{plain(quantity.name)}\n({better})", fontsize=10)
        axes.set_xlabel(f"points, less {plain(reference)}", fontsize=9)
        axes.grid(axis="y", visible=False)
        axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    places = {}
    for data in dict.fromkeys(each.data for each in paired):
        places[data] = float(np.mean([y for (of, _), y in lines.items() if of == data]))
    names = [plain(name.replace(" ", "\n", 1)) for name in places]
    panels[0].set_yticks(list(places.values()), names)
    panels[0].set_ylim(max(lines.values()) + 1, -1)
    drawn = {method for _, method in lines}
    legend(figure, {m: styles[m] for m in styles if m in drawn}, marker=True)
    return save(figure, path)


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
