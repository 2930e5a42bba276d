"""The page: tables and figures of all runs, filled into ``page.html.j2``."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr._files import write_atomically
from torchrl_osr.evaluation import NUM_RECENT, NUM_RESAMPLES
from torchrl_osr.report import published
from torchrl_osr.report.comparisons import (
    ALL_DATA,
    MIN_SEEDS,
    Difference,
    compare_all,
    quantities,
    suite_quantities,
    verdict,
)
from torchrl_osr.report.methods import comparison_notes
from torchrl_osr.report.plots import (
    Panel,
    draw_differences,
    draw_intervals,
    draw_panels,
    png,
)
from torchrl_osr.report.runs import Run, RunTables
from torchrl_osr.report.scores import (
    Band,
    Disturbed,
    Estimate,
    WayBack,
    area,
    by_run,
    decimal,
    disturbances,
    disturbed,
    episode_profile,
    estimate,
    iqm,
    recent,
    run_profile,
    score_curve,
    thresholds_of,
    undisturbed,
    way_back,
)

if TYPE_CHECKING:  # plots says what to install where there is no Matplotlib
    from matplotlib.figure import Figure

try:
    from jinja2 import Environment, PackageLoader
except ImportError as error:
    raise ImportError(
        f"the report needs {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

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
        tables: of :func:`~torchrl_osr.report.read_runs`.
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
    paired = [each for each in main if each.estimate is not None]
    means = {method: iqm(rows) for method, rows in _by_method(tables.episodes)}
    suites = [_suite(tables, suite, reference) for suite in tables.suites]
    figures = {
        "differences": draw_differences(paired, reference) if paired else None,
        "curves": _curves(tables),
        "profiles": _profiles(tables),
        "iqm": draw_intervals(means, "interquartile mean of the normalised score"),
    }
    for suite in suites:
        figures |= suite["figures"]
    pictures = {name: png(each) for name, each in figures.items() if each is not None}
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
        "mind": _pairing_notes(main, reference),
        "notes": comparison_notes(tables),
        "scores": _score_table(tables),
        "means": _mean_table(tables, means),
        "suites": suites,
        "published": _published(tables.runs),
        "paper": published,
        "every_run": _every_run(tables.runs),
    }
    environment = Environment(
        loader=PackageLoader("torchrl_osr.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"groups": groups, "slug": slug, "base64": _base64}
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        write_atomically(folder / f"{name}.png", picture)
    page = environment.get_template("page.html.j2").render(content)
    write_atomically(folder / PAGE, page)
    return folder / PAGE


def groups(frame: pd.DataFrame) -> list[tuple[str, list[tuple[str, Sequence[Any]]]]]:
    """Return a table's rows with their names, below the title of each outer index."""
    found: dict[str, list[tuple[str, Sequence[Any]]]] = {}
    rows = frame.itertuples(index=False, name=None)
    for index, cells in zip(frame.index, rows, strict=True):
        title, name = index if isinstance(index, tuple) else ("", index)
        found.setdefault(title, []).append((name, cells))
    return list(found.items())


def slug(name: str) -> str:
    """Return a name's letters and digits, fit for files and links."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower() or "unnamed"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _cells(episodes: pd.DataFrame) -> Iterator[tuple[tuple[str, str], pd.DataFrame]]:
    """Yield the rows of each data set and method, in their order."""
    yield from episodes.groupby(["data", "method"], sort=False)


def _by_method(episodes: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the rows of each method, in their order."""
    yield from episodes.groupby("method", sort=False)


def _frame(rows: Mapping[Any, Mapping[str, Any]]) -> pd.DataFrame:
    """Return a table of rows by method, or by data set and method."""
    frame = pd.DataFrame(list(rows.values()), dtype=object).fillna("")
    return frame.set_axis(pd.Index(list(rows), tupleize_cols=False))


def _cell(each: Estimate | None, unit: str = "", missing: str = "not defined") -> Cell:
    """Return an estimate with its interval below."""
    if each is None:
        return Cell(missing, kind="none")
    return Cell(decimal(each.mean) + unit, each.interval())


def _share(value: float | None) -> str:
    """Return a share in percent."""
    return "not known" if value is None else f"{100 * value:.0f} %"


def _curves(tables: RunTables) -> Figure:
    """Draw the learning curves, and the mean score of the data's episodes."""
    panels = []
    for data in tables.data:
        bands = {
            method: score_curve(rows)
            for (of, method), rows in _cells(tables.episodes)
            if of == data
        }
        thousands = {m: band._replace(x=band.x / 1000) for m, band in bands.items()}
        known = {run.data_score for run in tables.runs if run.data == data}
        levels = sorted({round(score, 1) for score in known if score is not None})
        panels.append(Panel(data, thousands, levels=levels))
    xlabel, ylabel = "thousand gradient steps", "normalised score"
    return draw_panels(panels, tables.methods, xlabel=xlabel, ylabel=ylabel)


def _score_table(tables: RunTables) -> pd.DataFrame:
    """Return the undisturbed scores, by data set and method."""
    rows, counts = {}, set()
    cells = tables.cells()
    for key, group in _cells(undisturbed(tables.episodes)):
        runs = cells[key]
        counts.add(min(NUM_RECENT, group["step"].nunique()))
        known = runs[0].data_score
        rows[key] = {
            "seeds": f"{len(runs)} ({', '.join(str(run.seed) for run in runs)})",
            "steps": f"{runs[0].steps:,}",
            "last": _cell(estimate(by_run(recent(group, 1)))),
            "recent": _cell(estimate(by_run(recent(group)))),
            "data": "unknown" if known is None else decimal(known),
        }
    number = " or ".join(str(count) for count in sorted(counts))
    return _frame(rows).rename(columns={"recent": f"mean of the last {number}"})


def _profiles(tables: RunTables) -> Figure | None:
    """Draw the performance profiles of the methods that have all data sets."""
    there = {
        method: rows
        for method, rows in _by_method(tables.episodes)
        if rows["data"].nunique() == len(tables.data)
    }
    if not there:
        return None
    thresholds = thresholds_of(tables.episodes)
    panels = [
        Panel(title, {m: profile(rows, thresholds) for m, rows in there.items()})
        for title, profile in (
            ("runs (mean of the last evaluations)", run_profile),
            ("single episodes of the last evaluations", episode_profile),
        )
    ]
    xlabel, ylabel = "normalised score τ", "share above τ"
    return draw_panels(panels, list(there), xlabel=xlabel, ylabel=ylabel, sharey=True)


def _mean_table(tables: RunTables, means: Mapping[str, Estimate]) -> pd.DataFrame:
    """Return the interquartile means, by method."""
    return _frame(
        {
            method: {
                "data sets": f"{rows['data'].nunique()} of {len(tables.data)}",
                "runs": str(rows["run"].nunique()),
                "IQM": _cell(means[method]),
            }
            for method, rows in _by_method(tables.episodes)
        }
    )


def _suite(tables: RunTables, suite: str, reference: str) -> dict[str, Any]:
    """Return tables and figures of one suite; those of a data set by its title."""
    rows = tables.episodes[tables.episodes["suite"] == suite]
    distances = dict(iter(tables.distances.groupby(["data", "method"])))
    none = tables.distances[:0]
    levels = disturbances(rows, suite)
    scores = {key: disturbed(group, suite) for key, group in _cells(rows)}
    ends = levels.index[levels["transient"]]
    figures, areas, ways = {}, {}, {}
    for data in dict.fromkeys(data for data, _ in scores):
        title = f"{data}, suite {suite}"
        here = {method: each for (of, method), each in scores.items() if of == data}
        figures[f"strength-{slug(title)}"] = _strengths(here, levels)
        areas[title] = _area_table(here, levels)
        back = {
            name: {
                m: way_back(rows[(rows["data"] == data) & (rows["method"] == m)],
                            distances.get((data, m), none), suite, name)
                for m in here
            }
            for name in ends
        }  # fmt: skip
        if back:
            figures[f"distance-{slug(title)}"] = _distances(back, list(here))
            figures[f"recovered-{slug(title)}"] = _recovered(back, list(here))
            ways[title] = _frame(
                {(name, m): _way_row(each) for name, by_method in back.items()
                 for m, each in by_method.items()}
            )  # fmt: skip
    compared = compare_all(tables, reference, suite_quantities(tables, suite))
    return {
        "name": suite,
        "scores": _frame({key: _suite_row(each) for key, each in scores.items()}),
        "areas": areas,
        "ways_back": ways,
        "differences": _difference_table(compared),
        "figures": figures,
    }


def _suite_row(found: Disturbed) -> dict[str, Any]:
    """Return a method's scores under a suite, with the decrease below."""
    row: dict[str, Any] = {"seeds": str(found.seeds), "clean": _cell(found.clean)}
    for name, score in found.scores.items():
        lost = found.decreases[name]
        small = f"{decimal(lost.mean)} % {lost.interval()}" if lost else NO_DECREASE
        row[name] = Cell(str(score), small)
    return row


def _strengths(found: Mapping[str, Disturbed], levels: pd.DataFrame) -> Figure:
    """Draw the share of the clean score against the strength of each series."""
    panels = []
    for series, group in levels.groupby("series", sort=False):
        bands = {}
        for method, each in found.items():
            points = [
                (place, 100 - lost.mean, 100 - lost.high, 100 - lost.low)
                for place, name in enumerate(group.index)
                if (lost := each.decreases[name])
            ]
            if points:
                bands[method] = Band(*np.array(points).T)
        ticks = [f"{strength:g}" for strength in group["strength"]]
        panels.append(Panel(str(series), bands, levels=[100], ticks=ticks))
    return draw_panels(
        panels, list(found), xlabel="strength", ylabel="% of the clean score",
        per_row=3, sharey=True,
    )  # fmt: skip


def _area_table(
    found: Mapping[str, Disturbed], levels: pd.DataFrame
) -> pd.DataFrame | None:
    """Return the area under each curve of two strengths or more; nothing if none is."""
    wide = {
        str(series): group["strength"]
        for series, group in levels.groupby("series", sort=False)
        if group["strength"].nunique() > 1
    }
    rows = {
        method: {name: _cell(area(each, of)) for name, of in wide.items()}
        for method, each in found.items()
    }
    return _frame(rows) if wide else None


Ways = Mapping[str, Mapping[str, WayBack | None]]
"""By disturbance and method."""


def _distances(back: Ways, methods: Sequence[str]) -> Figure:
    """Draw the distance to the data after each disturbance."""
    panels = []
    for name, ways in back.items():
        there = {method: each for method, each in ways.items() if each}
        bands = {m: e.distance for m, e in there.items() if e.distance}
        dotted = {m: d for m, e in there.items() if (d := e.undisturbed_distance)}
        panels.append(Panel(name, bands, dotted, levels=[1]))
    return draw_panels(
        panels, methods, xlabel="steps after the disturbance",
        ylabel="distance to the data", per_row=3,
    )  # fmt: skip


def _recovered(back: Ways, methods: Sequence[str]) -> Figure:
    """Draw the share of episodes that recovered after each disturbance."""
    panels = [
        Panel(name, {m: each.recovered for m, each in ways.items() if each})
        for name, ways in back.items()
    ]
    return draw_panels(
        panels, methods, xlabel="steps after the disturbance",
        ylabel="share recovered", per_row=3, sharey=True,
    )  # fmt: skip


def _way_row(each: WayBack | None) -> dict[str, Any]:
    """Return a method's way back after one disturbance."""
    if each is None:
        return {"disturbed": "none"}
    mean, low, high = (_share(float(line[-1])) for line in each.recovered[1:4])
    return {
        "disturbed": f"{_share(each.reached)} of {each.episodes}",
        "stood at its end": _share(each.stood),
        "stood later": _share(each.alive_after),
        "(undisturbed)": _share(each.undisturbed_alive),
        "recovered": Cell(mean, f"[{low}, {high}]"),
        "median steps": "over half never"
        if each.median is None
        else f"{each.median:g}",
        "score lost": _cell(each.decrease, " %", NO_DECREASE),
    }


def _difference_table(found: Sequence[Difference]) -> pd.DataFrame | None:
    """Return differences by data set and method; nothing if there are none."""
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    for each in found:
        row = rows.setdefault((each.data, each.method), {})
        row[each.quantity.name] = _difference_cell(each)
    return _frame(rows) if rows else None


def _difference_cell(each: Difference) -> Cell:
    """Return a difference with its mark."""
    if each.estimate is None:
        return Cell("not paired", kind="none")
    kind = each.verdict if each.told else "none"
    text = MARKS.get(each.verdict, "") + decimal(each.estimate.mean, "+")
    return Cell(text, each.estimate.interval("+"), kind)


def _pairing_notes(found: Sequence[Difference], reference: str) -> list[str]:
    """Return what else differs between partners, and which could not be paired."""
    notes = []
    for each in found:
        where = f"{each.data}, {each.method} and {reference}"
        if each.estimate is None:
            notes.append(
                f"{where} are not paired in {each.quantity.name}: {each.note}."
            )
        elif each.note and each.data != ALL_DATA:
            notes.append(f"{where}: {each.note}.")
    return list(dict.fromkeys(notes))


def _published(runs: Sequence[Run]) -> pd.DataFrame | None:
    """Return the paper's own numbers in the environments of the runs."""
    envs = {run.env for run in runs}
    rows = {
        (f"{env}, D4RL medium-expert", method): {
            name: Cell(f"{row[name, 'score']}", f"{row[name, 'decrease']} %")
            for name in published.DISTURBANCES
        }
        for (env, method), row in published.TABLE.iterrows()
        if env in envs
    }
    return _frame(rows) if rows else None


def _every_run(runs: Sequence[Run]) -> pd.DataFrame:
    """Return where each run comes from."""
    rows = {}
    for run in runs:
        trainer = {
            key: run.config[f"trainer.{key}"] for key in ("device", "num_threads")
        }
        versions = ", ".join(f"{name} {each}" for name, each in run.versions.items())
        overrides = None if run.overrides is None else " ".join(run.overrides) or "none"
        rows[run.folder] = {
            "method": run.method,
            "data": run.data,
            "seed": str(run.seed),
            "steps": f"{run.steps:,}",
            "device": f"{trainer['device']}, threads: {trainer['num_threads']}",
            "versions": versions or "not recorded",
            "overrides": overrides or "not recorded",
        }
    return _frame(rows)
