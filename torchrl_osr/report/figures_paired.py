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

    Filled markers: the interval leaves out 0. Hollow ones: not told apart.

    Args:
        found: the comparisons; those that are not paired are not drawn.
        wanted: the quantities, in the order of the panels.
        styles: of the methods.
        reference: the method that the others are compared with.
        path: the PNG to write.
    """
    paired = [each for each in found if each.difference is not None]
    data_sets = list(dict.fromkeys(each.data for each in paired))
    methods = [name for name in styles if any(each.method == name for each in paired)]
    # A line for each method, and one of air between data sets.
    lines = len(methods) + 1
    height = 0.7 + ROW * lines * len(data_sets)
    columns = min(3, len(wanted))
    figure, panels = grid(len(wanted), columns=columns, height=height, sharey=True)
    for axes, quantity in zip(panels, wanted, strict=True):
        axes.axvline(0, color=GREY, linewidth=1)
        for each in paired:
            if each.quantity.name == quantity.name and each.difference is not None:
                mean, low, high, _ = each.difference
                style = styles[each.method]
                told = each.verdict != "not told apart"
                y = data_sets.index(each.data) * lines + methods.index(each.method)
                axes.hlines(y, low, high, color=style.color, linewidth=1.4)
                axes.plot(
                    mean, y, style.marker, color=style.color, markersize=5,
                    markerfacecolor=style.color if told else "white",
                )  # fmt: skip
        better = "less is better" if quantity.sign < 0 else "more is better"
        axes.set_title(f"{plain(quantity.name)}\n({better})", fontsize=10)
        axes.set_xlabel(f"points, less {plain(reference)}", fontsize=9)
        axes.grid(axis="y", visible=False)
        axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    middle = np.arange(len(data_sets)) * lines + (len(methods) - 1) / 2
    names = [plain(name.replace(" ", "\n", 1)) for name in data_sets]
    panels[0].set_yticks(middle, names)
    panels[0].set_ylim(lines * len(data_sets) - 1, -1)
    legend(figure, {method: styles[method] for method in methods}, marker=True)
    return save(figure, path)
