"""Which states were visited? The data's density in a plane, and trajectories in it.

Shapes: ``N`` rows of the data, ``S`` observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.evaluation.figures import whole_picture
from torchrl_osr.evaluation.film_figures import COLORS, Take

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ImportError as error:
    raise ImportError(
        f"figures need {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

MARK: dict[str, Any] = {
    "markersize": 12,
    "markeredgecolor": "black",
    "linestyle": "",
}

CENTRAL = (0.2, 99.8)
"""Percentiles of the data that the plane shows: a few rows are far out."""


def principal_plane(
    rows: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the two directions of largest variance, and their shares of it.

    Args:
        rows: centred, ``[N, S]``.

    Returns:
        Directions ``[2, S]``, the largest entry of each positive, and shares ``[2]``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_osr.evaluation.visited_states import principal_plane
        >>> rows = np.array([[0.0, 3.0, 0.0], [0.0, -3.0, 0.0], [1.0, 0.0, 0.0],
        ...                  [-1.0, 0.0, 0.0]])
        >>> directions, shares = principal_plane(rows)
        >>> directions.round(6).tolist(), shares.round(6).tolist()
        ([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], [0.9, 0.1])
    """
    _, values, directions = np.linalg.svd(np.asarray(rows, float), full_matrices=False)
    plane = directions[:2]
    largest = np.take_along_axis(plane, np.abs(plane).argmax(1)[:, None], 1)
    variance = values**2
    return plane * np.sign(largest), variance[:2] / variance.sum()


def visited_states(
    data: NDArray[np.floating],
    takes: Sequence[Take],
    path: Path | str,
    *,
    title: str,
    note: str,
    event: str,
    steps: int,
) -> None:
    """Draw the data's density in their principal plane, and each take's way in it.

    Args:
        data: raw observations, ``[N, S]``; standardised here, like the takes.
        takes: drawn from the disturbance's end on, one panel each.
        path: the PNG to write.

    Keyword Args:
        title, note: two lines above.
        event: what the disturbance is called.
        steps: of each take at most.
    """
    loc, scale = data.mean(0), data.std(0)
    scale = np.where(scale > 0, scale, 1)
    rows = (data - loc) / scale
    plane, shares = principal_plane(rows)
    points, ways = rows @ plane.T, []
    for take in takes:
        # Who fell before the end is shown where they lie.
        seen = take.observations[take.end + min(take.last, 0) :][: steps + 1]
        ways.append((seen - loc) / scale @ plane.T)
    low, high = np.percentile(points, CENTRAL, axis=0)
    low = np.min([low, *(way.min(0) for way in ways)], axis=0) - 0.3
    high = np.max([high, *(way.max(0) for way in ways)], axis=0) + 0.3
    points = points[((points >= low) & (points <= high)).all(1)]
    figure = Figure(figsize=(4.2 * len(takes) + 1, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{title}\n{note}", fontsize=12)
    panels = figure.subplots(1, len(takes), sharey=True, squeeze=False)[0]
    for axes, take, way, color in zip(panels, takes, ways, COLORS, strict=False):
        cells = axes.hexbin(
            *points.T, gridsize=50, bins="log", cmap="Greys", mincnt=1, linewidths=0,
            extent=(low[0], high[0], low[1], high[1]),
        )  # fmt: skip
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        _draw_way(axes, take, way, color, steps)
    panels[0].set_ylabel(f"second principal component ({100 * shares[1]:.0f} %)")
    panels[len(takes) // 2].set_xlabel(
        f"first principal component ({100 * shares[0]:.0f} % of the variance)"
    )
    _legend(figure, event, steps)
    figure.colorbar(cells, ax=panels, label="rows of the data in a cell", pad=0.01)
    with whole_picture(path) as beside:
        figure.savefig(beside, dpi=110, format="png")


def _draw_way(
    axes: Any, take: Take, way: NDArray[np.float64], color: str, steps: int
) -> None:
    fell = take.fell and take.last <= steps
    end = f"falls after {take.last} steps" if fell else f"up after {steps} steps"
    if fell and take.last < 1:
        end = "falls at once"
    axes.set_title(f"{take.name}\n{end}", color=color, fontsize=12, fontweight="bold")
    # A white border, to be seen on dark cells.
    axes.plot(*way.T, color="white", linewidth=4, alpha=0.7)
    axes.plot(*way.T, color=color, linewidth=2)
    axes.plot(*way[:1].T, "o", color="white", **MARK)
    axes.plot(*way[-1:].T, "X" if fell else "s", color=color, **MARK)


def _legend(figure: Figure, event: str, steps: int) -> None:
    meanings = {"o": f"{event} ends", "X": "fall", "s": f"up {steps} steps later"}
    marks = [
        Line2D([], [], marker=marker, label=label, color="white", **MARK)
        for marker, label in meanings.items()
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False)
