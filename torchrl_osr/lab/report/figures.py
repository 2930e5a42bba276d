"""The report's three figures: learning curves, differences, and recovery.

Up to :data:`MOST` methods share a panel, each with a colour of its own. More have a row
of small panels each, with the others in grey.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from torchrl_osr.lab.evaluation.figures import BLUE, GREEN, GREY, ORANGE, new_figure
from torchrl_osr.lab.evaluation.statistics import Array, estimate
from torchrl_osr.lab.report.comparisons import Difference
from torchrl_osr.lab.report.runs import RunTables
from torchrl_osr.lab.report.tables import by_run, recovery_curve, undisturbed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Band: TypeAlias = tuple[Array, Array, Array, Array]
"""Places along the axis, means, and both ends of their 95 % bands, ``[T]`` each."""

COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
PALE = "#C8C8C8"

MOST = len(COLORS)
"""Methods that share a panel."""

WIDTH = 9.6
"""Of a figure, in inches."""


def learning_curves(tables: RunTables) -> Figure:
    """Draw scores over updates, and the mean score of the data's episodes."""
    panels: dict[str, dict[str, Band]] = {}
    levels = {}
    for (data, method), rows in undisturbed(tables.episodes).groupby(
        ["data", "method"], sort=False
    ):
        steps = rows.groupby("step")
        found = np.array([estimate(by_run(each))[:3] for _, each in steps])
        if rows["run"].nunique() == 1:
            found[:, 1:] = np.nan
        x = np.array(list(steps.groups)) / 1000
        panels.setdefault(data, {})[method] = (x, *found.T)
        levels[data] = tables.runs["data_score"][tables.runs["data"] == data].mean()
    return _panels(panels, tables, "thousand updates", tables.measure, levels)


def recovery(tables: RunTables) -> Figure | None:
    """Draw the share of disturbed episodes that have been back in the data."""
    ended = tables.episodes[tables.episodes["stood"].notna()]
    panels: dict[str, dict[str, Band]] = {}
    for (data, suite, method), there in ended.groupby(
        ["data", "suite", "method"], sort=False
    ):
        panels.setdefault(f"{data}, {suite}", {})[method] = recovery_curve(there)
    xlabel, ylabel = "steps after the disturbance", "share back in the data"
    return _panels(panels, tables, xlabel, ylabel, {}) if panels else None


def differences(found: Sequence[Difference], reference: str) -> Figure | None:
    """Draw differences with their intervals, a panel for each quantity and data set.

    Blue: better. Orange: worse. Hollow: no significant difference. Grey: too few seeds.
    """
    found = [each for each in found if each.estimate]
    if not found:
        return None
    signs = {each.quantity.name: each.quantity.sign for each in found}
    methods: dict[str, list[str]] = {}
    for each in found:
        of = methods.setdefault(each.data, [])
        of += [] if each.method in of else [each.method]
    names = {name: _wrapped(name, 30) for of in methods.values() for name in of}
    sizes = [
        1 + sum(1 + names[name].count("\n") for name in of) for of in methods.values()
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
        row[0].set_yticks(range(len(of)), [names[each] for each in of], fontsize=7.5)
        row[0].set_ylim(len(of) - 0.4, -0.6)
        for axes in row:
            _plain(axes, "x")
            axes.axvline(0, color=GREY, linewidth=1)
        for each in found:
            if each.data == data:
                axes = row[list(signs).index(each.quantity.name)]
                _mark(axes, each, of.index(each.method))
    for axes, (name, sign) in zip(grid[-1], signs.items(), strict=True):
        better = "more is better" if sign > 0 else "less is better"
        axes.set_xlabel(f"{_wrapped(name, 30)}\n({better})", fontsize=8)
    return figure


def _mark(axes: Axes, each: Difference, y: float) -> None:
    assert each.estimate is not None
    mean, low, high, _ = each.estimate
    known = {"better": BLUE, "worse": ORANGE, "no significant difference": "black"}
    color = known.get(each.verdict, GREY)
    axes.hlines(y, low, high, color=color, linewidth=1.4)
    face = "white" if color == "black" else color
    axes.plot(mean, y, "o", color=color, markersize=4.5, markerfacecolor=face)


def _panels(
    panels: Mapping[str, Mapping[str, Band]],
    tables: RunTables,
    xlabel: str,
    ylabel: str,
    levels: Mapping[str, float],
) -> Figure:
    """Draw methods against each other, or in rows of small panels if they are many."""
    methods = [m for m in tables.methods if any(m in of for of in panels.values())]
    many, alone = len(methods) > MOST, len(panels) == 1
    if many:
        cells = [(method, title) for method in methods for title in panels]
        columns = 4 if alone else len(panels)
    else:
        cells = [("", title) for title in panels]
        columns = min(3, len(panels))
    rows = -(-len(cells) // columns)
    height = (1.6 if alone else 1.1) * rows + 0.8 if many else 2.8 * rows + 1
    figure = new_figure(max(WIDTH, 2.2 * columns), height)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=many, sharey="col")
    colors, lines = dict(zip(methods, COLORS, strict=False)), {}
    for axes, (method, title) in zip(grid.flat, cells, strict=False):
        for name, (x, mean, low, high) in panels[title].items():
            if many and name != method:
                axes.plot(x, mean, color=PALE, linewidth=0.7, zorder=1)
                continue
            color = colors.get(name, BLUE) if not many else BLUE
            lines[name] = axes.plot(x, mean, color=color, linewidth=1.6)[0]
            axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
        if title in levels:
            axes.axhline(levels[title], color=GREY, linewidth=1, linestyle=":")
        _plain(axes, "y")
        above = method if many and alone else title
        if alone or not many or method == methods[0]:
            axes.set_title(_wrapped(above, 100 // columns), fontsize=8 if many else 10)
        if many and not alone and title == next(iter(panels)):
            name = _wrapped(method, 24)
            axes.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=7.5)
    for axes in grid.flat[len(cells) :]:
        axes.set_visible(False)
    if not many:
        figure.legend(
            list(lines.values()), [_wrapped(name, 100) for name in lines],
            loc="outside upper center", frameon=False, fontsize=8,
            ncols=max(1, 100 // (max(map(len, methods)) + 8)),
        )  # fmt: skip
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    return figure


def _plain(axes: Axes, axis: Literal["x", "y"]) -> None:
    """Pale grid lines across one axis."""
    axes.grid(axis=axis, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7.5)


def _wrapped(text: str, width: int) -> str:
    """A name on lines of a width; Matplotlib takes no part of it for a formula."""
    return "\n".join(textwrap.wrap(text, width)).replace("$", r"\$")
