"""The figure of an evaluation under disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchrl_osr.lab.evaluation.drawing import (
    BLUE,
    GREY,
    IN_WORDS,
    new_figure,
    save_figure,
)
from torchrl_osr.lab.evaluation.episodes import measure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNDISTURBED = "undisturbed"


def robustness_figure(
    summary: Sequence[Mapping[str, Any]],
    evaluations: Sequence[Mapping[str, Any]],
    path: Path | str,
    *,
    title: str,
) -> None:
    """Draw scores under disturbances and, after those that end, distances to the data.

    Without scores it draws returns: over the strength, where each kind has several;
    otherwise each disturbance has a line of its own.
    """
    curves = distance_curves(evaluations)
    figure = new_figure(11 if curves else 6.5, 4.6, layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(1, 2 if curves else 1, squeeze=False)[0]
    series: dict[str, list[Mapping[str, Any]]] = {}
    for row in summary:
        series.setdefault(row["kind"], []).append(row)
    strengths = [{row["strength"] for row in rows} for rows in series.values()]
    sweep = all(len(each) > 1 for each in strengths) and (
        sum(map(len, strengths)) == len(summary)
    )
    (_over_strength if sweep else _one_by_one)(axes[0], series)
    clean = summary[0][f"clean_{measure_of(summary[0])}"]
    line = axes[0].axhline if sweep else axes[0].axvline
    line(clean, color=GREY, linestyle="--", linewidth=1, label=UNDISTURBED)
    axes[0].legend(frameon=False, fontsize=8)
    if curves:
        _draw_curves(axes[1], curves)
    for each in figure.axes:
        each.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def distance_curves(
    evaluations: Sequence[Mapping[str, Any]],
) -> dict[str, tuple[list[int], list[float]]]:
    """Mean distance to the data around the end of each disturbance.

    Returns:
        Offsets and distances in units of the threshold, by name of the disturbance;
        those of all undisturbed episodes are named ``"undisturbed"``. Offsets with
        fewer than a tenth of the episodes at offset 0 are left out.
    """
    parts: dict[str, list[tuple[Any, Any]]] = {}
    offset: list[int] = []
    for played in (played for each in evaluations for played in each["levels"]):
        distance = played["distance"]
        if distance is None:
            continue
        offset = distance["offset"]
        for name, prefix in ((played["name"], ""), (UNDISTURBED, "clean_")):
            pair = distance[f"{prefix}mean"], distance[f"{prefix}count"]
            parts.setdefault(name, []).append(pair)
    curves = {}
    for name, pairs in parts.items():
        mean, count = (np.array(each, dtype=float) for each in zip(*pairs, strict=True))
        episodes = count.sum(0)
        shown = episodes >= max(0.1 * episodes[offset.index(0)], 1)
        total = np.where(count > 0, mean * count, 0).sum(0)  # None became NaN
        curves[name] = (
            np.array(offset)[shown].tolist(),
            (total[shown] / episodes[shown]).tolist(),
        )
    return {name: curve for name, curve in curves.items() if curve[0]}


def _colors(start: float, end: float, number: int) -> NDArray[np.float64]:
    """Colours, ``[number, 4]``, that colour-blind readers and printers keep apart."""
    from matplotlib import colormaps

    colors: NDArray[np.float64] = colormaps["viridis"](np.linspace(start, end, number))
    return colors


def _over_strength(axes: Axes, series: Mapping[str, list[Mapping[str, Any]]]) -> None:
    every = [row for rows in series.values() for row in rows]
    measure = measure_of(every[0])
    low, high = f"{measure}_low", f"{measure}_high"
    colors = _colors(0.1, 0.8, len(series))
    for color, (kind, rows) in zip(colors, series.items(), strict=True):
        rows = sorted(rows, key=lambda row: float(row["strength"]))
        x = [row["strength"] for row in rows]
        axes.fill_between(
            x, [row[low] for row in rows], [row[high] for row in rows],
            color=color, alpha=0.15, linewidth=0,
        )  # fmt: skip
        axes.plot(x, [row[measure] for row in rows], "o-", color=color, label=kind)
    axes.set(xlabel="strength", ylabel=f"{IN_WORDS[measure]} (95 % interval)")
    if all(row[low] >= 0 for row in every):
        axes.set_ylim(0)


def _one_by_one(axes: Axes, series: Mapping[str, list[Mapping[str, Any]]]) -> None:
    rows = [row for each in series.values() for row in each][::-1]
    measure = measure_of(rows[0])
    mean = np.array([row[measure] for row in rows])
    names = f"{measure}_low", f"{measure}_high"
    ends = np.array([[row[name] for name in names] for row in rows]).T
    axes.errorbar(
        mean, range(len(rows)), xerr=np.abs(ends - mean), fmt="o", color=BLUE,
        capsize=3, label="disturbed (mean, 95 % interval)",
    )  # fmt: skip
    axes.set_yticks(range(len(rows)), [row["name"] for row in rows])
    axes.set(xlabel=IN_WORDS[measure])
    if ends.min() >= 0:
        axes.set_xlim(0)


def _draw_curves(
    axes: Axes, curves: Mapping[str, tuple[list[int], list[float]]]
) -> None:
    disturbed = {name: curve for name, curve in curves.items() if name != UNDISTURBED}
    colors = _colors(0, 0.9, len(disturbed))
    for color, (name, curve) in zip(colors, disturbed.items(), strict=True):
        axes.plot(*curve, color=color, linewidth=1.5, label=name)
    if UNDISTURBED in curves:
        axes.plot(*curves[UNDISTURBED], color=GREY, linewidth=1.5, label=UNDISTURBED)
    axes.axhline(1, color=GREY, linestyle="--", linewidth=1, label="95 % of the data")
    axes.axvline(0, color=GREY, linewidth=0.5)
    axes.set(
        xlabel="steps since the disturbance ended",
        ylabel="distance to the data / threshold",
        ylim=(0, None),
    )
    axes.set_title("mean of the episodes that still run", fontsize=9)
    axes.legend(frameon=False, fontsize=8)
