"""The report's three figures: learning curves, differences, and recovery."""

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

# Each method has its own combination.
COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", ":", "-.")

WIDTH = 9.6  # inches

VERDICTS = {"better": BLUE, "worse": ORANGE, "no significant difference": "black"}


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
        axes = grid[list(methods).index(each.data)][
            list(signs).index(each.quantity.name)
        ]
        y, color = (
            list(methods[each.data]).index(each.method),
            VERDICTS.get(each.verdict),
        )
        axes.hlines(y, low, high, color=color or GREY, linewidth=1.4)
        face = "white" if color == "black" else color or GREY
        axes.plot(
            mean, y, "o", color=color or GREY, markersize=4.5, markerfacecolor=face
        )
    for axes, (name, sign) in zip(grid[-1], signs.items(), strict=True):
        better = "more is better" if sign > 0 else "less is better"
        axes.set_xlabel(f"{_wrapped(name, 30)}\n({better})", fontsize=8)
    return figure


def _panels(
    panels: Mapping[str, Mapping[str, Band]],
    tables: RunTables,
    xlabel: str,
    ylabel: str,
    levels: Mapping[str, float],
) -> Figure:
    """Draw a panel for each data set, with all methods."""
    methods = tables.methods  # a method has the same line in all figures
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(WIDTH, 2.8 * rows + 1)
    grid = figure.subplots(rows, columns, squeeze=False, sharey="col")
    lines = {}
    for axes, (title, bands) in zip(grid.flat, panels.items(), strict=False):
        for name, (x, mean, low, high) in bands.items():
            number = methods.index(name)
            color = COLORS[number % len(COLORS)]
            line = LINES[number // len(COLORS) % len(LINES)]
            lines[name] = axes.plot(x, mean, line, color=color, linewidth=1.6)[0]
            axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
        if title in levels:
            axes.axhline(levels[title], color=GREY, linewidth=1, linestyle=":")
        _plain(axes, "y")
        axes.set_title(_wrapped(title, 100 // columns), fontsize=10)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    figure.legend(
        list(lines.values()), [_wrapped(name, 100) for name in lines],
        loc="outside upper center", frameon=False, fontsize=8,
        ncols=max(1, 100 // (max(map(len, methods)) + 8)),
    )  # fmt: skip
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    return figure


def _plain(axes: Axes, axis: Literal["x", "y"]) -> None:
    """Draw pale grid lines across one axis."""
    axes.grid(axis=axis, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7.5)


def _wrapped(text: str, width: int) -> str:
    """Wrap a name; Matplotlib must not take a part of it for a formula."""
    return "\n".join(textwrap.wrap(text, width)).replace("$", r"\$")
