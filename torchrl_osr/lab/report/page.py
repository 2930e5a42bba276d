"""The page: verdict, tables and learning curves of all runs."""

from __future__ import annotations

import base64
import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from torchrl_osr._files import write_atomically
from torchrl_osr.lab.evaluation.figures import GREY, save_figure
from torchrl_osr.lab.evaluation.statistics import NUM_RESAMPLES, Estimate, estimate
from torchrl_osr.lab.report.comparisons import (
    MIN_SEEDS,
    compare_all,
    difference_table,
    verdict,
)
from torchrl_osr.lab.report.runs import RunTables, comparison_notes
from torchrl_osr.lab.report.tables import (
    by_run,
    recovery_table,
    robustness_table,
    score_table,
    text,
)

# Each method has its own combination. The palette is Okabe and Ito's.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", ":", "-.")


def write_report(
    tables: RunTables, folder: Path, *, reference: str | None = None, command: str = ""
) -> Path:
    """Write ``report.html``, its tables and its figure; return its path.

    Methods are compared with the ``reference``. Default: the first method. The page
    prints the ``command``.
    """
    methods = tables.methods
    reference = methods[0] if reference is None else reference
    if reference not in methods:
        raise ValueError(f"no method {reference!r}; there are: {'; '.join(methods)}")
    found = compare_all(tables, reference)
    runs = tables.runs.drop(columns="data_score").set_index("folder")
    frames = {
        "scores": score_table(tables),
        "differences": difference_table(found),
        "recoverable": recovery_table(tables.saved, reference),
    }
    for suite in tables.suites:
        played = tables.episodes[tables.episodes["suite"] == suite]
        frames[f"robustness-{suite}"] = robustness_table(played)
    frames["runs"] = runs.assign(versions=runs["versions"].map(", ".join))
    frames = {name: frame for name, frame in frames.items() if not frame.empty}
    folder.mkdir(parents=True, exist_ok=True)
    curves = folder / "curves.png"
    save_figure(learning_curves(tables), curves, dpi=130)
    for name, frame in frames.items():
        file = re.sub(r"[^\w.-]+", "-", name)  # suites have any name
        write_atomically(folder / f"{file}.csv", numbers(frame).to_csv())
    loader = PackageLoader("torchrl_osr.lab.report", ".")
    template = Environment(loader=loader, autoescape=True).get_template("page.html.j2")
    page = template.render(
        tables=tables,
        frames={name: frame.map(text) for name, frame in frames.items()},
        reference=reference,
        curves=base64.b64encode(curves.read_bytes()).decode(),
        verdict=verdict(found, reference),
        notes=comparison_notes(tables),
        command=command,
        num_resamples=NUM_RESAMPLES,
        min_seeds=MIN_SEEDS,
    )
    write_atomically(folder / "report.html", page)
    return folder / "report.html"


def numbers(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table with columns of mean, low and high for each one of estimates."""
    columns: dict[str, Any] = {}
    for name, cells in frame.items():
        estimates = [cell if isinstance(cell, Estimate) else None for cell in cells]
        if not any(estimates):
            columns[str(name)] = cells
            continue
        for place, end in enumerate(("", " low", " high")):
            columns[f"{name}{end}"] = [each and each[place] for each in estimates]
    return pd.DataFrame(columns, index=frame.index)


def learning_curves(tables: RunTables) -> Figure:
    """Draw scores over updates, and the mean score of the data's episodes."""
    columns = min(3, len(tables.data))
    rows = -(-len(tables.data) // columns)
    figure = Figure(figsize=(9.6, 2.8 * rows + 1), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex="col")
    panels = dict(zip(tables.data, grid.flat, strict=False))
    for data, axes in panels.items():
        level = tables.runs["data_score"][tables.runs["data"] == data].mean()
        axes.axhline(level, color=GREY, linewidth=1, linestyle=":")
        axes.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7.5, labelbottom=True)
        axes.set_title(_wrapped(data, 100 // columns), fontsize=10)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    lines = {}
    undisturbed = tables.episodes[tables.episodes["suite"] == ""]
    for (data, method), played in undisturbed.groupby(["data", "method"], sort=False):
        steps = played.groupby("step")
        found = np.array([estimate(by_run(each))[:3] for _, each in steps])
        x, (mean, low, high) = np.array(list(steps.groups)) / 1000, found.T
        number = tables.methods.index(method)
        color = COLORS[number % len(COLORS)]
        line = LINES[number // len(COLORS) % len(LINES)]
        style = f"{line}{'' if len(x) > 1 else 'o'}"
        (lines[method],) = panels[data].plot(x, mean, style, color=color, linewidth=1.6)
        if played["run"].nunique() > 1:
            panels[data].fill_between(x, low, high, color=color, alpha=0.15, lw=0)
    figure.legend(
        list(lines.values()), [_wrapped(name, 100) for name in lines],
        loc="outside upper center", frameon=False, fontsize=8,
        ncols=max(1, 100 // (max(map(len, lines)) + 8)),
    )  # fmt: skip
    figure.supxlabel("thousand updates", fontsize=10)
    figure.supylabel(tables.measure, fontsize=10)
    return figure


def _wrapped(text: str, width: int) -> str:
    """Wrap a name; Matplotlib must not take a part of it for a formula."""
    return "\n".join(textwrap.wrap(text, width)).replace("$", r"\$")
