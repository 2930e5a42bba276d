"""The report's figures: learning curves and differences."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from torchrl_osr.lab.evaluation.figures import BLUE, GREEN, GREY, ORANGE, new_figure
from torchrl_osr.lab.evaluation.statistics import estimate
from torchrl_osr.lab.report.comparisons import Difference
from torchrl_osr.lab.report.runs import RunTables
from torchrl_osr.lab.report.tables import by_run, undisturbed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Each method has its own combination.
COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", ":", "-.")

WIDTH = 9.6  # inches

VERDICTS = {"better": BLUE, "worse": ORANGE, "no significant difference": "black"}


def learning_curves(tables: RunTables) -> Figure:
    """Draw scores over updates, and the mean score of the data's episodes."""
    columns = min(3, len(tables.data))
    rows = -(-len(tables.data) // columns)
    figure = new_figure(WIDTH, 2.8 * rows + 1)
    grid = figure.subplots(rows, columns, squeeze=False, sharex="col")
    panels = dict(zip(tables.data, grid.flat, strict=False))
    for data, axes in panels.items():
        level = tables.runs["data_score"][tables.runs["data"] == data].mean()
        axes.axhline(level, color=GREY, linewidth=1, linestyle=":")
        _plain(axes, "y")
        axes.set_title(_wrapped(data, 100 // columns), fontsize=10)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    lines = {}
    groups = undisturbed(tables.episodes).groupby(["data", "method"], sort=False)
    for (data, method), played in groups:
        steps = played.groupby("step")
        found = np.array([estimate(by_run(each))[:3] for _, each in steps])
        x, (mean, low, high) = np.array(list(steps.groups)) / 1000, found.T
        number = tables.methods.index(method)
        color = COLORS[number % len(COLORS)]
        line = LINES[number // len(COLORS) % len(LINES)]
        (lines[method],) = panels[data].plot(x, mean, line, color=color, linewidth=1.6)
        if played["run"].nunique() > 1:
            panels[data].fill_between(
                x, low, high, color=color, alpha=0.15, linewidth=0
            )
    figure.legend(
        list(lines.values()), [_wrapped(name, 100) for name in lines],
        loc="outside upper center", frameon=False, fontsize=8,
        ncols=max(1, 100 // (max(map(len, lines)) + 8)),
    )  # fmt: skip
    figure.supxlabel("thousand updates", fontsize=10)
    figure.supylabel(tables.measure, fontsize=10)
    return figure


def differences(found: Sequence[Difference], reference: str) -> Figure | None:
    """Draw differences with their intervals, a panel for each quantity and data set.

    Blue: better. Orange: worse. Hollow: no significant difference. Grey: too few seeds.
    """
    found = [each for each in found if each.estimate]
    if not found:
        return None
    signs = {each.quantity.name: each.quantity.sign for each in found}
    methods: dict[str, dict[str, str]] = {}
    for each in found:
        methods.setdefault(each.data, {})[each.method] = _wrapped(each.method, 30)
    sizes = [
        1 + sum(1 + name.count("\n") for name in of.values()) for of in methods.values()
    ]
    width = max(WIDTH, 3 + 2.4 * len(signs))
    figure = new_figure(width, 0.2 * sum(sizes) + 0.3 * len(sizes) + 1.4)
    figure.suptitle(_wrapped(f"Difference to {reference}", 90), fontsize=10)
    grid = figure.subplots(
        len(methods), len(signs), squeeze=False, sharex="col", sharey="row",
        height_ratios=sizes,
    )  # fmt: skip
    for row, (data, of) in zip(grid, methods.items(), strict=True):
        row[0].set_title(_wrapped(data, 40), fontsize=8, fontweight="bold", loc="left")
        row[0].set_yticks(range(len(of)), list(of.values()), fontsize=7.5)
        row[0].set_ylim(len(of) - 0.4, -0.6)
        for axes in row:
            _plain(axes, "x")
            axes.axvline(0, color=GREY, linewidth=1)
    for each in found:
        assert each.estimate is not None
        mean, low, high, _ = each.estimate
        row = grid[list(methods).index(each.data)]
        axes = row[list(signs).index(each.quantity.name)]
        y = list(methods[each.data]).index(each.method)
        color = VERDICTS.get(each.verdict, GREY)
        face = "white" if color == "black" else color
        axes.hlines(y, low, high, color=color, linewidth=1.4)
        axes.plot(mean, y, "o", color=color, markersize=4.5, markerfacecolor=face)
    for axes, (name, sign) in zip(grid[-1], signs.items(), strict=True):
        better = "more is better" if sign > 0 else "less is better"
        axes.set_xlabel(f"{_wrapped(name, 30)}\n({better})", fontsize=8)
    return figure


def _plain(axes: Axes, axis: Literal["x", "y"]) -> None:
    """Draw pale grid lines across one axis."""
    axes.grid(axis=axis, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7.5)


def _wrapped(text: str, width: int) -> str:
    """Wrap a name; Matplotlib must not take a part of it for a formula."""
    return "\n".join(textwrap.wrap(text, width)).replace("$", r"\$")
