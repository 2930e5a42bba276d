"""The page: verdict, tables and figures of all runs, as HTML, CSV and PNG."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import pandas as pd

from torchrl_osr._extras import needed_by
from torchrl_osr._files import write_atomically
from torchrl_osr.lab.evaluation.figures import save_figure
from torchrl_osr.lab.evaluation.statistics import NUM_RESAMPLES, Estimate
from torchrl_osr.lab.report import figures
from torchrl_osr.lab.report.comparisons import (
    MIN_SEEDS,
    compare_all,
    difference_table,
    verdict,
)
from torchrl_osr.lab.report.runs import RunTables, comparison_notes
from torchrl_osr.lab.report.tables import (
    robustness_table,
    saved_table,
    score_table,
    text,
)

with needed_by("the report needs", "train"):
    from jinja2 import Environment, PackageLoader


def write_report(
    tables: RunTables, folder: Path, *, reference: str | None = None, command: str = ""
) -> Path:
    """Write ``report.html``, and each table and figure by itself; return its path.

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
        "recoverable": saved_table(tables, reference),
    }
    for suite in tables.suites:
        frames[f"robustness-{suite}"] = robustness_table(tables, suite)
    frames["runs"] = runs.assign(versions=runs["versions"].map(", ".join))
    frames = {name: frame for name, frame in frames.items() if not frame.empty}
    drawn = {
        "curves": figures.learning_curves(tables),
        "differences": figures.differences(found, reference),
    }
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, figure in drawn.items():
        if figure is not None:
            path = folder / f"{name}.png"
            save_figure(figure, path, dpi=130)
            pictures[name] = base64.b64encode(path.read_bytes()).decode()
    for name, frame in frames.items():
        file = re.sub(r"[^\w.-]+", "-", name)  # suites have any name
        write_atomically(folder / f"{file}.csv", numbers(frame).to_csv())
    loader = PackageLoader("torchrl_osr.lab.report", ".")
    template = Environment(loader=loader, autoescape=True).get_template("page.html.j2")
    page = template.render(
        tables=tables,
        frames={name: frame.map(text) for name, frame in frames.items()},
        reference=reference,
        pictures=pictures,
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
