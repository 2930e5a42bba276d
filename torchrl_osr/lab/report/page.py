"""The page: tables and figures of all runs, filled into ``page.html.j2``."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr._extras import needed_by
from torchrl_osr._files import write_atomically
from torchrl_osr.lab.evaluation.statistics import NUM_RESAMPLES
from torchrl_osr.lab.evaluation.training_summary import NUM_RECENT
from torchrl_osr.lab.report.comparisons import (
    ALL_DATA,
    MIN_SEEDS,
    Difference,
    compare_all,
    quantities,
    suite_quantities,
    verdict,
)
from torchrl_osr.lab.report.methods import RunTables, comparison_notes
from torchrl_osr.lab.report.plots import Panel, draw_differences, draw_panels, png
from torchrl_osr.lab.report.saved import Saved, saved_states
from torchrl_osr.lab.report.scores import (
    Estimate,
    WayBack,
    by_run,
    counted,
    decimal,
    disturbed,
    estimate,
    iqm,
    profile,
    recent,
    score_curve,
    undisturbed,
    way_back,
)

if TYPE_CHECKING:  # plots says what to install where there is no Matplotlib
    from matplotlib.figure import Figure

with needed_by("the report needs", "train"):
    from jinja2 import Environment, PackageLoader

PAGE = "report.html"
MARKS = {"better": "▲ ", "worse": "▼ ", "not told apart": "= "}
NO_DECREASE = "% of a clean score not above 0"


class Cell(NamedTuple):
    """A cell of a table.

    Attributes:
        text: plain.
        small: a second line below it, smaller.
        kind: a class of the style sheet.
    """

    text: str
    small: str = ""
    kind: str = ""


def write_report(
    tables: RunTables, folder: Path, *, reference: str | None = None, command: str = ""
) -> Path:
    """Write the page, and its figures as PNG files.

    Args:
        tables: of :func:`~torchrl_osr.lab.report.read_runs`.
        folder: made if need be; files of a former report are replaced.

    Keyword Args:
        reference: the method that the others are compared with. Default: the first.
        command: how the report was asked for. Default: not shown.

    Returns:
        The page's path.

    Raises:
        ValueError: if there is no such method, naming those that there are.
        OSError: if a file cannot be written.
    """
    methods = tables.methods
    reference = methods[0] if reference is None else reference
    if reference not in methods:
        raise ValueError(f"no method {reference!r}; there are: {'; '.join(methods)}")
    main = compare_all(tables, reference, quantities(tables))
    paired = [each for each in main if each.estimate]
    suites = [_suite(tables, suite, reference) for suite in tables.suites]
    figures = {
        "differences": draw_differences(paired, reference) if paired else None,
        "curves": _curves(tables),
        "profiles": _profiles(tables),
    }
    for suite in suites:
        figures |= suite["figures"]
    pictures = {name: png(figure) for name, figure in figures.items() if figure}
    runs = tables.runs.drop(columns="data_score").set_index("folder")
    saved = list(saved_states(tables, reference))
    content = {
        "tables": tables,
        "reference": reference,
        "command": command,
        "num_resamples": NUM_RESAMPLES,
        "num_recent": NUM_RECENT,
        "min_seeds": MIN_SEEDS,
        "pictures": pictures,
        "verdict": verdict(main, reference),
        "together": _difference_table([d for d in main if d.data == ALL_DATA]),
        "by_data": _difference_table([d for d in main if d.data != ALL_DATA]),
        "pairing": _pairing_notes(main, reference),
        "notes": comparison_notes(tables),
        "scores": _score_table(tables),
        "means": _mean_table(tables),
        "suites": suites,
        "saved": _saved_table(saved, reference),
        "saved_by_disturbance": _saved_by_disturbance(saved),
        "every_run": runs.assign(versions=runs["versions"].map(", ".join)).astype(str),
    }
    environment = Environment(
        loader=PackageLoader("torchrl_osr.lab.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"groups": groups, "slug": slug, "base64": _base64}
    environment.filters["counted"] = counted
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        write_atomically(folder / f"{name}.png", picture)
    page = environment.get_template("page.html.j2").render(content)
    write_atomically(folder / PAGE, page)
    return folder / PAGE


def groups(frame: pd.DataFrame) -> list[tuple[str, list[tuple[str, Sequence[Any]]]]]:
    """A table's rows with their names, below the title of each outer index."""
    found: dict[str, list[tuple[str, Sequence[Any]]]] = {}
    rows = frame.itertuples(index=False, name=None)
    for index, cells in zip(frame.index, rows, strict=True):
        title, name = index if isinstance(index, tuple) else ("", index)
        found.setdefault(title, []).append((name, cells))
    return list(found.items())


def slug(name: str) -> str:
    """A name's letters and digits, fit for files and links."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower() or "unnamed"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _frame(rows: Mapping[Any, Mapping[str, Any]]) -> pd.DataFrame:
    """A table of rows by method, or by data set and method."""
    frame = pd.DataFrame(list(rows.values()), dtype=object).fillna("")
    return frame.set_axis(pd.Index(list(rows), tupleize_cols=False))


def _cell(each: Estimate | None, unit: str = "") -> Cell:
    """An estimate with its interval below; ``None`` is a decrease that is none."""
    if each is None:
        return Cell(NO_DECREASE, kind="none")
    return Cell(decimal(each.mean) + unit, each.interval())


def _share(value: float) -> str:
    """A share in percent."""
    return "not known" if np.isnan(value) else f"{100 * value:.0f} %"


def _curves(tables: RunTables) -> Figure:
    """Draw the learning curves, and the mean score of the data's episodes."""
    panels = []
    for data, rows in tables.episodes.groupby("data", sort=False):
        bands = {
            method: (band := score_curve(group))._replace(x=band.x / 1000)
            for method, group in rows.groupby("method", sort=False)
        }
        known = tables.runs["data_score"][tables.runs["data"] == data]
        panels.append(Panel(data, bands, sorted(known.dropna().round(1).unique())))
    xlabel, ylabel = "thousand gradient steps", tables.measure
    return draw_panels(panels, tables.methods, xlabel=xlabel, ylabel=ylabel)


def _score_table(tables: RunTables) -> pd.DataFrame:
    """The undisturbed scores, by data set and method."""
    runs = tables.runs.groupby(["data", "method"])
    rows = {}
    for key, group in undisturbed(tables.episodes).groupby(
        ["data", "method"], sort=False
    ):
        of = runs.get_group(key)
        known = of["data_score"].iloc[0]
        rows[key] = {
            "seeds": f"{len(of)} ({', '.join(map(str, of['seed']))})",
            "steps": f"{of['steps'].iloc[0]:,}",
            "last": _cell(estimate(by_run(recent(group, 1)))),
            f"mean of the last {NUM_RECENT}": _cell(estimate(by_run(recent(group)))),
            "data": "unknown" if pd.isna(known) else decimal(known),
        }
    return _frame(rows)


def _profiles(tables: RunTables) -> Figure | None:
    """Draw the performance profiles of the methods that have all data sets."""
    scores = recent(tables.episodes)["score"]
    thresholds = np.linspace(min(0.0, scores.min()), scores.max(), 121)
    bands = {
        method: profile(rows, thresholds)
        for method, rows in tables.episodes.groupby("method", sort=False)
        if rows["data"].nunique() == len(tables.data)
    }
    if not bands:
        return None
    panel = Panel("Runs, by the mean of their last evaluations", bands)
    return draw_panels(
        [panel],
        list(bands),
        xlabel=f"{tables.measure} τ",
        ylabel="share of runs above τ",
        order=tables.methods,
    )


def _mean_table(tables: RunTables) -> pd.DataFrame:
    """The interquartile means, by method."""
    return _frame(
        {
            method: {
                "data sets": f"{rows['data'].nunique()} of {len(tables.data)}",
                "runs": str(rows["run"].nunique()),
                "IQM": _cell(iqm(rows)),
            }
            for method, rows in tables.episodes.groupby("method", sort=False)
        }
    )


def _suite(tables: RunTables, suite: str, reference: str) -> dict[str, Any]:
    """Tables and figures of one suite."""
    rows = tables.episodes[tables.episodes["suite"] == suite]
    distances = tables.distances[tables.distances["suite"] == suite]
    scores = {}
    for key, group in rows.groupby(["data", "method"], sort=False):
        found = disturbed(group)
        (clean, _), runs = found.pop(""), group["run"].nunique()
        scores[key] = {"seeds": str(runs), "clean": _cell(clean)} | {
            name: Cell(
                str(score),
                f"{decimal(lost.mean)} % {lost.interval()}" if lost else NO_DECREASE,
            )
            for name, (score, lost) in found.items()
        }
    figures, recovery = {}, {}
    for data, curves in distances.groupby("data", sort=False):
        title = f"{data}, suite {suite}"
        of_data = dict(iter(rows[rows["data"] == data].groupby("method", sort=False)))
        ways = {
            (name, method): back
            for (name, method), group in curves.groupby(
                ["disturbance", "method"], sort=False
            )
            if (back := way_back(of_data[method], group, name))
        }
        if ways:
            recovery[title] = _frame({key: _way_row(way) for key, way in ways.items()})
            for kind, figure in _recovery_figures(ways, tables.methods).items():
                figures[f"{kind}-{slug(title)}"] = figure
    compared = compare_all(tables, reference, suite_quantities(tables, suite))
    return {
        "name": suite,
        "scores": _frame(scores),
        "recovery": recovery,
        "differences": _difference_table(compared),
        "figures": figures,
    }


def _recovery_figures(
    ways: Mapping[tuple[str, str], WayBack], order: Sequence[str]
) -> dict[str, Figure]:
    """Draw distance and recovered share along the steps after each disturbance."""
    methods = list(dict.fromkeys(method for _, method in ways))
    distance: dict[str, Panel] = {}
    recovered: dict[str, Panel] = {}
    for (name, method), way in ways.items():
        distance.setdefault(name, Panel(name, {}, [1.0])).bands[method] = way.distance
        recovered.setdefault(name, Panel(name, {})).bands[method] = way.recovered
    options: dict[str, Any] = {"xlabel": "steps after the disturbance", "order": order}
    return {
        "distance": draw_panels(
            list(distance.values()), methods, ylabel="distance to the data", **options
        ),
        "recovered": draw_panels(
            list(recovered.values()),
            methods,
            ylabel="share recovered",
            sharey=True,
            **options,
        ),
    }


def _way_row(each: WayBack) -> dict[str, Any]:
    """A method's way back after one disturbance."""
    mean, low, high = (_share(float(line[-1])) for line in each.recovered[1:])
    return {
        "disturbed": f"{_share(each.reached)} of {each.num_episodes}",
        "stood at its end": _share(each.stood),
        "stood later": _share(each.alive_after),
        "(undisturbed)": _share(each.undisturbed_alive),
        "recovered": Cell(mean, f"[{low}, {high}]"),
        "median steps": f"{each.median:g}" if each.median < np.inf else "most never",
        "score lost": _cell(each.decrease, " %"),
    }


def _saved_table(saved: Sequence[Saved], reference: str) -> pd.DataFrame | None:
    """What each method saves of the recoverable states; nothing if none was played."""
    rows = {}
    for each in saved:
        cells = {name: _cell(share, " %") for name, share in each.shares.items()}
        if each.recovered is not None:
            cells[f"R against {reference}"] = _cell(each.recovered, " %")
        title = f"{each.data}, states {each.states}"
        rows[title, each.method] = {"seeds": str(len(each.seeds))} | cells
    return _frame(rows) if rows else None


def _saved_by_disturbance(saved: Sequence[Saved]) -> pd.DataFrame | None:
    """The same of the recoverable states, a row for each disturbance."""
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    for each in saved:
        title = f"{each.data}, states {each.states}"
        for name, share in each.by_disturbance.items():
            rows.setdefault((title, name), {})[each.method] = _cell(share, " %")
    return _frame(rows) if rows else None


def _difference_table(found: Sequence[Difference]) -> pd.DataFrame | None:
    """Differences by data set and method; nothing if there are none."""
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    for each in found:
        if each.estimate:
            text = MARKS.get(each.verdict, "") + decimal(each.estimate.mean, "+")
            kind = each.verdict if each.told else "none"
            cell = Cell(text, each.estimate.interval("+"), kind)
        else:
            cell = Cell("not paired", kind="none")
        rows.setdefault((each.data, each.method), {})[each.quantity.name] = cell
    return _frame(rows) if rows else None


def _pairing_notes(found: Sequence[Difference], reference: str) -> list[str]:
    """Which methods could not be paired, or not in all seeds."""
    notes = [
        f"{each.data}, {each.method} and {reference}"
        + (": " if each.estimate else f" are not paired in {each.quantity.name}: ")
        + f"{each.note}."
        for each in found
        if each.note and each.data != ALL_DATA
    ]
    return list(dict.fromkeys(notes))
