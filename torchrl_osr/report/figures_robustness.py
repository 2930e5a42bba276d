"""The report's figures of disturbed episodes: what is kept, and the way back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchrl_osr.report.figures import (
    GREY,
    Styles,
    draw,
    grid,
    legend,
    plain,
    save,
)
from torchrl_osr.report.recovery import Recovery
from torchrl_osr.report.robustness import Disturbed, series_of

COLUMNS = 3


def draw_strengths(
    results: Mapping[str, Disturbed], styles: Styles, title: str, path: Path
) -> Path:
    """Draw the share of the clean score against the strength, a panel a kind.

    Strengths stand at equal distances: they are in units of their own, and few.
    Methods stand side by side, so that their intervals can be told apart.

    Args:
        results: of each method on one data set.
        styles: of the methods.
        title: names data set and suite.
        path: the PNG to write.
    """
    levels = next(iter(results.values())).levels
    series = series_of(levels)
    figure, panels = grid(len(series), columns=COLUMNS, height=2.5, sharey=True)
    figure.suptitle(plain(title), fontsize=12)
    offsets = np.linspace(-0.3, 0.3, len(results)) if len(results) > 1 else [0.0]
    for axes, (name, indices) in zip(panels, series.items(), strict=True):
        axes.axhline(100, color=GREY, linewidth=1, linestyle=(0, (1, 2)))
        for offset, (method, result) in zip(offsets, results.items(), strict=True):
            found = [(place, result.decreases[i]) for place, i in enumerate(indices)]
            known = [(place + offset, each) for place, each in found if each]
            if not known:
                continue
            style = styles[method]
            x = [place for place, _ in known]
            axes.vlines(
                x, [100 - each.high for _, each in known],
                [100 - each.low for _, each in known], color=style.color, linewidth=1.4,
            )  # fmt: skip
            axes.plot(
                x, [100 - each.mean for _, each in known], marker=style.marker,
                color=style.color, linestyle=style.line, linewidth=0.8, markersize=4.5,
            )  # fmt: skip
        ticks = [f"{levels[i].strength:g}" for i in indices]
        axes.set_xticks(np.arange(len(indices)), ticks)
        axes.set_xlim(-0.6, len(indices) - 0.4)
        axes.set_title(plain(name), fontsize=10)
        axes.set_xlabel("strength", fontsize=9)
    for axes in panels[::COLUMNS]:
        axes.set_ylabel("% of the clean score")
    shown = {method: styles[method] for method in results}
    legend(figure, shown, marker=True)
    return save(figure, path)


def draw_recoveries(
    results: Mapping[str, Mapping[str, Recovery | None]],
    styles: Styles,
    title: str,
    path: Path,
) -> Path:
    """Draw distance to the data and share recovered, two panels a disturbance.

    Args:
        results: of each level and method on one data set.
        styles: of the methods.
        title: names data set and suite.
        path: the PNG to write.
    """
    names = list(results)
    blocks = [names[i : i + COLUMNS] for i in range(0, len(names), COLUMNS)]
    columns = len(blocks[0])
    # Two rows a block: distance above, share below. sharey would mix the two.
    figure, panels = grid(2 * len(blocks) * columns, columns=columns, height=2.2)
    figure.suptitle(plain(title), fontsize=12)
    for number, block in enumerate(blocks):
        above, below = (
            panels[(2 * number + row) * columns :][:columns] for row in (0, 1)
        )
        for axes in [*above[len(block) :], *below[len(block) :]]:
            axes.set_visible(False)
        for name, top, bottom in zip(block, above, below, strict=False):
            top.set_title(plain(name), fontsize=10)
            top.axhline(1, color=GREY, linewidth=1)
            bottom.set_ylim(0, 1.02)
            bottom.set_xlabel("steps after the disturbance", fontsize=9)
            for method, result in results[name].items():
                if result is None:
                    continue
                if result.distance is not None:
                    draw(top, result.distance, styles[method])
                clean = result.undisturbed_distance
                if clean is not None:
                    color = styles[method].color
                    top.plot(clean.x, clean.mean, ":", color=color, linewidth=0.9)
                draw(bottom, result.recovered, styles[method])
                bottom.sharex(top)
        above[0].set_ylabel("distance / q95", fontsize=9)
        below[0].set_ylabel("share recovered", fontsize=9)
    shown = {method for each in results.values() for method in each}
    legend(figure, {method: styles[method] for method in styles if method in shown})
    return save(figure, path)
