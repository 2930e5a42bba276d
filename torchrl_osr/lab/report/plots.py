"""The report's figures: lines with their bands, and intervals row by row.

Up to :data:`MOST` methods share a panel, each with a colour of its own. More have a row
of small panels each, on the others in grey.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torchrl_osr._extras import needed_by
from torchrl_osr.lab.report.comparisons import Difference
from torchrl_osr.lab.report.scores import Band

with needed_by("figures need", "train"):
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from PIL import Image  # Matplotlib needs it, too

# Okabe and Ito's palette, which colour-blind readers can tell apart, without its
# yellow, too pale for a line.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY, PALE = "#666666", "#C8C8C8"

MOST = len(COLORS)
"""Methods that share a panel."""

WIDTH = 9.6
"""Of a figure, in inches: fonts are then equally large on the page."""

DPI = 130


class Panel(NamedTuple):
    """What is drawn along one pair of axes.

    Attributes:
        title: above it.
        bands: by method.
        levels: horizontal lines that all methods are measured by.
    """

    title: str
    bands: dict[str, Band]
    levels: Sequence[float] = ()


def draw_panels(
    panels: Sequence[Panel],
    methods: Sequence[str],
    *,
    xlabel: str,
    ylabel: str,
    sharey: bool = False,
    order: Sequence[str] = (),
) -> Figure:
    """Draw methods against each other, in small multiples if they are many.

    Those among the first of ``order`` have the same colour in all figures.
    """
    first = order[: len(COLORS)]
    named = first if {*methods} <= {*first} else methods
    colors = dict(zip(named, COLORS, strict=False))
    if len(methods) > MOST:
        figure = _small_multiples(panels, methods, sharey)
    else:
        columns = min(3 if len(panels) > 4 else 2, len(panels))
        rows = -(-len(panels) // columns)
        figure, grid = _figure(rows, columns, 2.8 * rows + 0.6, sharey=sharey)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw(axes, panel, {each: colors[each] for each in methods})
            axes.set_title(plain(panel.title), fontsize=10)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        handles = [
            Line2D([], [], color=colors[method], label=plain(method))
            for method in methods
        ]
        in_row = max(1, min(len(methods), 110 // (max(map(len, methods)) + 8)))
        figure.legend(
            handles=handles, loc="outside upper center", frameon=False, ncols=in_row
        )
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    return figure


def draw_differences(differences: Sequence[Difference], reference: str) -> Figure:
    """Draw differences with their intervals, a panel for each quantity and data set.

    Coloured: better or worse. Hollow: not told apart. Grey: there is no verdict.
    """
    quantities = {each.quantity.name: each.quantity.sign for each in differences}
    methods: dict[str, list[str]] = {}
    for each in differences:
        of = methods.setdefault(each.data, [])
        of += [] if each.method in of else [each.method]
    sizes = [len(of) + 1 for of in methods.values()]
    figure, grid = _figure(
        len(methods), len(quantities), 0.17 * sum(sizes) + 0.3 * len(sizes) + 1,
        sharex="col", sharey="row", height_ratios=sizes,
    )  # fmt: skip
    figure.set_figwidth(max(WIDTH, 3.2 * len(quantities)))
    for row, (data, of) in zip(grid, methods.items(), strict=True):
        row[0].set_title(plain(data), fontsize=8, fontweight="bold", loc="left")
        row[0].set_yticks(range(len(of)), [plain(each) for each in of], fontsize=7.5)
        row[0].set_ylim(len(of) - 0.4, -0.6)
        for axes, name in zip(row, quantities, strict=True):
            axes.tick_params(axis="x", labelsize=8)
            axes.grid(axis="y", visible=False)
            axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
            axes.axvline(0, color=GREY, linewidth=1)
            for each in differences:
                if (each.data, each.quantity.name) == (data, name):
                    _mark(axes, each, of.index(each.method))
    for axes, (name, sign) in zip(grid[-1], quantities.items(), strict=True):
        better = "more is better" if sign > 0 else "less is better"
        axes.set_xlabel(
            f"{plain(name)}\nless {plain(reference)} ({better})", fontsize=8
        )
    return figure


def png(figure: Figure) -> bytes:
    """PNG file of a figure."""
    file = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(file, dpi=DPI, facecolor="white", format="png")
    picture = Image.open(file).convert("RGB")
    file = io.BytesIO()
    # 256 colours: a third of the bytes, and nobody sees it.
    picture.quantize(256, dither=Image.Dither.NONE).save(file, "png", optimize=True)
    return file.getvalue()


def plain(text: str) -> str:
    """Text that Matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def _broken(text: str, width: int) -> str:
    """A name on several lines, broken behind spaces and underscores."""
    lines = textwrap.wrap(plain(text).replace("_", "_ "), max(width, 8))
    return "\n".join(lines).replace("_ ", "_")


def _small_multiples(
    panels: Sequence[Panel], methods: Sequence[str], sharey: bool
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
        others = dict.fromkeys((each for each in methods if each != method), PALE)
        _draw(axes, panel, others | {method: COLORS[0]})
        axes.tick_params(labelsize=6)
        if alone:
            axes.set_title(_broken(method, 30), fontsize=8)
        elif panel is panels[0]:
            name = _broken(method, 18)
            axes.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=7.5)
    for axes in grid.flat[len(cells) :]:
        axes.set_visible(False)
    if alone:
        figure.suptitle(plain(panels[0].title), fontsize=10)
    else:
        for axes, panel in zip(grid[0], panels, strict=True):
            axes.set_title(_broken(panel.title, 120 // columns), fontsize=8)
    return figure


def _figure(
    rows: int, columns: int, height: float, **options: Any
) -> tuple[Figure, Any]:
    """A figure and its panels, ``[rows, columns]``."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, **options)
    for axes in grid.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
    return figure, grid


def _draw(axes: Axes, panel: Panel, colors: Mapping[str, str]) -> None:
    """Draw methods' lines and bands, pale ones without a band, and the levels."""
    for level in panel.levels:
        axes.axhline(level, color=GREY, linewidth=1, linestyle=":")
    for method, color in colors.items():
        if method in panel.bands:
            x, mean, low, high = panel.bands[method]
            width = 0.7 if color == PALE else 1.6
            axes.plot(x, mean, color=color, linewidth=width)
            if color != PALE:
                axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)


def _mark(axes: Axes, each: Difference, y: float) -> None:
    """Draw one difference."""
    assert each.estimate is not None
    mean, low, high, _ = each.estimate
    known = {"better": COLORS[0], "worse": COLORS[1], "not told apart": "black"}
    color = known.get(each.verdict, GREY)
    face = "white" if each.verdict == "not told apart" else color
    axes.hlines(y, low, high, color=color, linewidth=1.4)
    axes.plot(mean, y, "o", color=color, markersize=4.5, markerfacecolor=face)
