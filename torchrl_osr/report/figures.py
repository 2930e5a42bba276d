"""The report's figures of undisturbed scores; and how all its figures look.

A method has the same colour and line in every figure. Legends stand below the panels,
where they cover nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchrl_osr._files import whole_file
from torchrl_osr.report.checks import cells, data_of, methods_of
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import (
    Curve,
    Estimate,
    coverage,
    episode_profile,
    learning_curve,
    run_profile,
    thresholds_of,
)

try:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ImportError as error:
    raise ImportError(
        f"figures need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

# Okabe and Ito's palette, which colour-blind readers can tell apart, without its
# yellow, too pale for a line. More methods than colours: other lines and markers.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 2, 1, 2)))
MARKERS = ("o", "s", "^", "D")
GREY = "#666666"

WIDTH = 9.6
"""Of every figure, in inches: fonts are then equally large on the page."""
DPI = 130


class Style(NamedTuple):
    """How a method is drawn.

    Attributes:
        color: of line, band and marker.
        line: dashes.
        marker: of single points.
        band: opacity of the band.
    """

    color: str
    line: Any
    marker: str
    band: float


Styles = Mapping[str, Style]


def method_styles(methods: Sequence[str]) -> dict[str, Style]:
    """Return each method's style, by their order; bands of many are paler."""
    band = 0.15 if len(methods) <= 5 else 0.07
    return {
        method: Style(
            COLORS[index % len(COLORS)],
            LINES[index // len(COLORS) % len(LINES)],
            MARKERS[index // len(COLORS) % len(MARKERS)],
            band,
        )
        for index, method in enumerate(methods)
    }


def plain(text: str) -> str:
    """Return text that Matplotlib does not take for a formula."""
    return text.replace("$", r"\$")


def grid(
    panels: int, *, columns: int = 2, height: float = 2.9, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels, row by row; those too many are hidden.

    Args:
        panels: how many.

    Keyword Args:
        columns: at most so many side by side. Default 2.
        height: of a row, in inches. Default 2.9.
        options: of Matplotlib's ``subplots``.
    """
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(WIDTH, height * rows + 0.7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        each.set_axisbelow(True)
    for each in axes[panels:]:
        each.set_visible(False)
    return figure, axes[:panels]


def grid_sideways(axes: Axes) -> None:
    """Turn a panel's lines: values go from left to right."""
    axes.grid(axis="y", visible=False)
    axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)


def legend(
    figure: Figure, styles: Styles, *, more: Sequence[Line2D] = (), marker: bool = False
) -> None:
    """Explain the methods below the panels."""
    handles = [
        Line2D(
            [], [], color=style.color, linestyle="" if marker else style.line,
            marker=style.marker if marker else "", label=plain(method),
        )
        for method, style in styles.items()
    ]  # fmt: skip
    widest = max(map(len, styles))
    figure.legend(
        handles=[*handles, *more], loc="outside lower center", frameon=False,
        ncols=max(1, min(len(handles) + len(more), 110 // (widest + 8))),
    )  # fmt: skip


def draw(axes: Axes, curve: Curve, style: Style) -> None:
    """Draw a line with its band."""
    axes.plot(
        curve.x, curve.mean, color=style.color, linestyle=style.line, linewidth=1.6
    )
    if curve.over:
        axes.fill_between(
            curve.x, curve.low, curve.high, color=style.color, alpha=style.band,
            linewidth=0,
        )  # fmt: skip


def save(figure: Figure, path: Path) -> Path:
    """Write a figure, all or nothing; return where."""
    with whole_file(path) as file:
        figure.savefig(file, dpi=DPI, facecolor="white", format="png")
    return path


def draw_curves(runs: Sequence[Run], styles: Styles, path: Path) -> Path:
    """Draw the score over gradient steps, a panel a data set."""
    figure, panels = grid(len(data_of(runs)))
    groups = cells(runs)
    for axes, data in zip(panels, data_of(runs), strict=True):
        for method, style in styles.items():
            if (data, method) in groups:
                curve = learning_curve(groups[data, method])
                draw(axes, curve._replace(x=curve.x / 1000), style)
        scores = [run.data_score for run in runs if run.data == data]
        for score in {round(each, 1) for each in scores if each is not None}:
            axes.axhline(score, color=GREY, linestyle=(0, (1, 2)), linewidth=1.4)
        axes.set_title(plain(data), fontsize=11)
        axes.set_xlabel("thousand gradient steps")
        axes.set_ylabel("normalised score")
    own = Line2D([], [], color=GREY, linestyle=(0, (1, 2)), label="mean of the data")
    legend(figure, styles, more=[own])
    return save(figure, path)


def draw_profiles(runs: Sequence[Run], styles: Styles, path: Path) -> Path:
    """Draw the share of runs, and of episodes, above each score."""
    figure, panels = grid(2, height=3.3, sharey=True)
    thresholds = thresholds_of(runs)
    drawn = [method for method in styles if not coverage(runs, method)]
    for axes, profile in zip(panels, (run_profile, episode_profile), strict=True):
        for method in drawn:
            draw(axes, profile(runs, method, thresholds), styles[method])
        axes.set_xlabel("normalised score τ")
    panels[0].set_ylabel("share above τ")
    panels[0].set_title("runs (mean of the last evaluations)", fontsize=11)
    panels[1].set_title("single episodes of the last evaluations", fontsize=11)
    legend(figure, {method: styles[method] for method in drawn})
    return save(figure, path)


def draw_means(means: Mapping[str, Estimate], styles: Styles, path: Path) -> Path:
    """Draw each method's interquartile mean with its interval."""
    figure, (axes,) = grid(1, height=0.32 * len(means) + 0.5)
    for place, (method, each) in enumerate(means.items()):
        style = styles[method]
        axes.plot([each.low, each.high], [place, place], color=style.color, linewidth=2)
        axes.plot(each.mean, place, style.marker, color=style.color, markersize=7)
    axes.set_yticks(np.arange(len(means)), [plain(method) for method in means])
    axes.set_ylim(len(means) - 0.5, -0.5)
    grid_sideways(axes)
    axes.set_xlabel("interquartile mean of the normalised score")
    return save(figure, path)


def all_methods(runs: Sequence[Run]) -> dict[str, Style]:
    """Return the styles of all methods of the report."""
    return method_styles(methods_of(runs))
