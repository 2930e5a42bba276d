"""The report's figures: lines with their bands, and intervals row by row.

Up to :data:`MOST` methods share a panel, each with a colour of its own. More have a row
of small panels each, on the others in grey.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchrl_osr.report.comparisons import Difference
from torchrl_osr.report.scores import Band, Estimate

try:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from PIL import Image  # Matplotlib needs it, too
except ImportError as error:
    raise ImportError(
        f"figures need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

# Okabe and Ito's palette, which colour-blind readers can tell apart, without its
# yellow, too pale for a line.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P")
GREY, PALE = "#666666", "#C8C8C8"

MOST = len(COLORS)
"""Methods that share a panel."""

WIDTH = 9.6
"""Of every figure, in inches: fonts are then equally large on the page."""

DPI = 130

DOTTED = (0, (1, 2))


class Panel(NamedTuple):
    """What is drawn along one pair of axes.

    Attributes:
        title: above it.
        bands: by method.
        dotted: lines without a band, by method.
        levels: horizontal lines that all methods are measured by.
        ticks: labels of the places 0, 1, ...; with them, the places are points with
            intervals. ``None``: a line along numbers.
    """

    title: str
    bands: Mapping[str, Band]
    dotted: Mapping[str, Band] = {}
    levels: Sequence[float] = ()
    ticks: Sequence[str] | None = None


def draw_panels(
    panels: Sequence[Panel],
    methods: Sequence[str],
    *,
    xlabel: str,
    ylabel: str,
    per_row: int = 2,
    sharey: bool = False,
) -> Figure:
    """Draw methods against each other, in small multiples if they are many.

    Args:
        panels: one for each data set or disturbance.
        methods: in the order of their colours.

    Keyword Args:
        xlabel: of all panels.
        ylabel: of all panels.
        per_row: panels side by side; small multiples have all. Default 2.
        sharey: whether all have one range of values. Default: no.
    """
    if len(methods) > MOST:
        return _small_multiples(panels, methods, xlabel, ylabel, sharey)
    columns = min(per_row, len(panels))
    rows = -(-len(panels) // columns)
    # Side by side where there are points, so that intervals can be told apart.
    offsets = np.linspace(-0.3, 0.3, len(methods)) if len(methods) > 1 else [0.0]
    figure, grid = _figure(rows, columns, 2.8 * rows + 0.6, sharey=sharey)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _prepare(axes, panel, fontsize=10)
        axes.set_title(plain(panel.title), fontsize=10)
        for number, method in enumerate(methods):
            _draw(axes, panel, method, number, offsets[number])
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    handles = [
        Line2D([], [], color=COLORS[number], label=plain(method),
               marker=MARKERS[number] if panels[0].ticks else "")
        for number, method in enumerate(methods)
    ]  # fmt: skip
    widest = max(map(len, methods))
    figure.legend(
        handles=handles, loc="outside upper center", frameon=False,
        ncols=max(1, min(len(handles), 110 // (widest + 8))),
    )  # fmt: skip
    return figure


def draw_intervals(means: Mapping[str, Estimate], xlabel: str) -> Figure:
    """Draw a mean with its interval in a row for each method."""
    figure, grid = _figure(1, 1, 0.3 * len(means) + 0.9)
    axes = grid[0, 0]
    for place, each in enumerate(means.values()):
        axes.hlines(place, each.low, each.high, color=COLORS[0], linewidth=2)
        axes.plot(each.mean, place, "o", color=COLORS[0], markersize=6)
    axes.set_yticks(np.arange(len(means)), [plain(method) for method in means])
    axes.set_ylim(len(means) - 0.5, -0.5)
    _sideways(axes)
    axes.set_xlabel(xlabel)
    return figure


def draw_differences(differences: Sequence[Difference], reference: str) -> Figure:
    """Draw differences with their intervals, a panel for each quantity.

    Coloured: better or worse. Hollow: not told apart. Grey: there is no verdict.

    Args:
        differences: that are paired.
        reference: the method that the others are compared with.
    """
    names = list(dict.fromkeys(each.quantity.name for each in differences))
    data_sets = list(dict.fromkeys(each.data for each in differences))
    there = dict.fromkeys((each.data, each.method) for each in differences)
    keys = sorted(there, key=lambda key: data_sets.index(key[0]))  # stable
    # One line of air above each data set, for its name.
    lines = {
        key: place + 1.3 * (data_sets.index(key[0]) + 1)
        for place, key in enumerate(keys)
    }
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    height = 0.17 * (max(lines.values()) + 2) + 1.1
    figure, grid = _figure(rows, columns, rows * height, sharey=True)
    for axes in list(grid.flat)[len(names) :]:
        axes.set_visible(False)
    for axes, name in zip(grid.flat, names, strict=False):
        found = [each for each in differences if each.quantity.name == name]
        axes.axvline(0, color=GREY, linewidth=1)
        for each in found:
            _mark(axes, each, lines[each.data, each.method])
        better = "more is better" if found[0].quantity.sign > 0 else "less is better"
        axes.set_title(f"{plain(name)}\n({better})", fontsize=9)
        axes.set_xlabel(f"points, less {plain(reference)}", fontsize=8)
        _sideways(axes)
    first = grid[0, 0]
    first.set_yticks(
        list(lines.values()), [plain(method) for _, method in lines], fontsize=7.5
    )
    for axes in grid[:, 0]:
        for data in data_sets:
            top = min(line for key, line in lines.items() if key[0] == data)
            axes.annotate(
                plain(data), (0, top - 1.1), xycoords=("axes fraction", "data"),
                xytext=(-4, 0), textcoords="offset points", ha="right", va="center",
                fontsize=8, fontweight="bold", annotation_clip=False,
            )  # fmt: skip
    first.set_ylim(max(lines.values()) + 1, -0.5)
    return figure


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    file = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(file, dpi=DPI, facecolor="white", format="png")
    picture = Image.open(file).convert("RGB")
    file = io.BytesIO()
    # 256 colours: a third of the bytes, and nobody sees it.
    picture.quantize(256, dither=Image.Dither.NONE).save(file, "png", optimize=True)
    return file.getvalue()


def plain(text: str) -> str:
    """Return text that Matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def _broken(text: str, width: int) -> str:
    """Return a name on several lines, broken behind spaces and underscores."""
    lines = textwrap.wrap(plain(text).replace("_", "_ "), max(width, 8))
    return "\n".join(lines).replace("_ ", "_")


def _small_multiples(
    panels: Sequence[Panel],
    methods: Sequence[str],
    xlabel: str,
    ylabel: str,
    sharey: bool,
) -> Figure:
    """Draw a row for each method, the others in grey; one panel alone: side by side."""
    alone = len(panels) == 1
    columns = 4 if alone else len(panels)
    rows = -(-len(methods) * len(panels) // columns)
    figure, grid = _figure(
        rows, columns, (1.6 if alone else 1.05) * rows + 0.8,
        sharex="col", sharey=True if sharey or alone else "col",
    )  # fmt: skip
    cells = [(method, panel) for method in methods for panel in panels]
    for axes, (method, panel) in zip(grid.flat, cells, strict=False):
        _prepare(axes, panel, fontsize=7)
        for other in methods:
            if other != method:
                _draw(axes, panel, other, None, 0.0)
        _draw(axes, panel, method, 0, 0.0)
        if alone:
            axes.set_title(_broken(method, 30), fontsize=8)
        elif panel is panels[0]:
            name = _broken(method, 18)
            axes.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=7.5)
    for axes in list(grid.flat)[len(cells) :]:
        axes.set_visible(False)
    if alone:
        figure.suptitle(plain(panels[0].title), fontsize=10)
    else:
        for axes, panel in zip(grid[0], panels, strict=True):
            axes.set_title(_broken(panel.title, 120 // columns), fontsize=8)
    figure.supxlabel(xlabel, fontsize=9)
    figure.supylabel(ylabel, fontsize=9)
    return figure


def _figure(
    rows: int, columns: int, height: float, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure and its panels, ``[rows, columns]``."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, **options)
    for axes in grid.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
    return figure, grid


def _prepare(axes: Axes, panel: Panel, fontsize: float) -> None:
    """Draw what is not a method's own."""
    for level in panel.levels:
        axes.axhline(level, color=GREY, linewidth=1, linestyle=DOTTED)
    axes.tick_params(labelsize=fontsize - 1)
    if panel.ticks is not None:
        axes.set_xticks(np.arange(len(panel.ticks)), panel.ticks)
        axes.set_xlim(-0.6, len(panel.ticks) - 0.4)


def _draw(
    axes: Axes, panel: Panel, method: str, number: int | None, offset: float
) -> None:
    """Draw a method's line and interval; without a number, a grey line."""
    band = panel.bands.get(method)
    if band is None:
        return
    color = PALE if number is None else COLORS[number]
    if panel.ticks is None:
        axes.plot(
            band.x, band.mean, color=color, linewidth=0.7 if number is None else 1.6
        )
        if number is None:
            return
        if band.over:
            axes.fill_between(
                band.x, band.low, band.high, color=color, alpha=0.15, linewidth=0
            )
        dotted = panel.dotted.get(method)
        if dotted is not None:
            axes.plot(dotted.x, dotted.mean, ":", color=color, linewidth=0.9)
        return
    x = band.x + offset
    marker = "_" if number is None else MARKERS[number]
    axes.plot(x, band.mean, color=color, marker=marker, linewidth=0.8, markersize=4.5)
    if number is not None:
        axes.vlines(x, band.low, band.high, color=color, linewidth=1.4)


def _mark(axes: Axes, each: Difference, y: float) -> None:
    """Draw one difference."""
    assert each.estimate is not None
    mean, low, high, _ = each.estimate
    known = {"better": COLORS[0], "worse": COLORS[1], "not told apart": "black"}
    color = known.get(each.verdict, GREY)
    axes.hlines(y, low, high, color=color, linewidth=1.4)
    axes.plot(
        mean, y, "o", color=color, markersize=4.5,
        markerfacecolor=color if each.told or color == GREY else "white",
    )  # fmt: skip


def _sideways(axes: Axes) -> None:
    """Turn a panel's lines: values go from left to right."""
    axes.grid(axis="y", visible=False)
    axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
