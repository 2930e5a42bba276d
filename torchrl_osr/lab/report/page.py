"""The page: verdict, tables and figures of all runs, as HTML, Markdown, CSV and PNG."""

from __future__ import annotations

import base64
import io
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
    mean_table,
    robustness_table,
    saved_table,
    score_table,
    text,
)

with needed_by("the report needs", "train"):
    from jinja2 import Environment, PackageLoader

PAGE = "report.html"


def write_report(
    tables: RunTables,
    folder: Path,
    *,
    reference: str | None = None,
    command: str = "",
) -> Path:
    """Write ``report.html``, ``report.md``, and each table and figure by itself.

    The others are compared with the method ``reference``. Default: the first. The page
    names the ``command``.

    Returns:
        The page's path.

    Raises:
        ValueError: if there is no such method, with those that there are.
    """
    methods = tables.methods
    reference = methods[0] if reference is None else reference
    if reference not in methods:
        raise ValueError(f"no method {reference!r}; there are: {'; '.join(methods)}")
    found = compare_all(tables, reference)
    runs = tables.runs.drop(columns="data_score").set_index("folder")
    frames = {
        "scores": score_table(tables),
        "means": mean_table(tables),
        "differences": difference_table(found),
        "recoverable": saved_table(tables, reference),
        **{
            f"robustness-{suite}": robustness_table(tables, suite)
            for suite in tables.suites
        },
        "runs": runs.assign(versions=runs["versions"].map(", ".join)),
    }
    frames = {name: frame for name, frame in frames.items() if not frame.empty}
    drawn = {
        "curves": figures.learning_curves(tables),
        "differences": figures.differences(found, reference),
        "recovery": figures.recovery(tables),
    }
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, figure in drawn.items():
        if figure is not None:
            save_figure(figure, folder / f"{name}.png", dpi=130)
            pictures[name] = base64.b64encode(
                (folder / f"{name}.png").read_bytes()
            ).decode()
    for name, frame in frames.items():
        file = re.sub(r"[^\w.-]+", "-", name)  # suites have any name
        write_atomically(folder / f"{file}.csv", numbers(frame).to_csv())
    content = {
        "tables": tables,
        "frames": {name: frame.map(text) for name, frame in frames.items()},
        "reference": reference,
        "pictures": pictures,
        "verdict": verdict(found, reference),
        "notes": comparison_notes(tables),
        "command": command,
        "num_resamples": NUM_RESAMPLES,
        "min_seeds": MIN_SEEDS,
    }
    environment = Environment(
        loader=PackageLoader("torchrl_osr.lab.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("page.html.j2").render(content)
    write_atomically(folder / PAGE, page)
    write_atomically(folder / "report.md", markdown(content))
    return folder / PAGE


def numbers(frame: pd.DataFrame) -> pd.DataFrame:
    """Table with three columns, mean, low and high, for each column of estimates."""
    columns: dict[str, Any] = {}
    for name, cells in frame.items():
        estimates = cells.map(lambda cell: isinstance(cell, Estimate))
        if not estimates.any():
            columns[str(name)] = cells
            continue
        for place, end in enumerate(("", " low", " high")):
            columns[f"{name}{end}"] = cells.map(
                lambda cell, place=place: (
                    cell[place] if isinstance(cell, Estimate) else None
                )
            )
    return pd.DataFrame(columns, index=frame.index)


def markdown(content: dict[str, Any]) -> str:
    """The page's texts and tables in Markdown."""
    file = io.StringIO()
    print("# Report of runs\n", file=file)
    for title in ("verdict", "notes"):
        print("\n".join(f"- {each}" for each in content[title]), end="\n\n", file=file)
    for name, frame in content["frames"].items():
        rows = frame.reset_index()
        print(f"## {name}\n", file=file)
        lines = [list(rows), ["---"] * len(list(rows)), *rows.values.tolist()]
        for line in lines:
            cells = (str(cell).replace("|", "\\|") for cell in line)
            print(f"| {' | '.join(cells)} |", file=file)
        print(file=file)
    return file.getvalue()
