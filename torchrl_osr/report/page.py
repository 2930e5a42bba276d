"""The page: tables and figures of all runs, filled into ``page.html.j2``."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from torchrl_osr._files import write_atomically
from torchrl_osr.evaluation.statistics import NUM_RESAMPLES
from torchrl_osr.evaluation.summary import NUM_RECENT
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

try:
    from jinja2 import Environment, PackageLoader
except ImportError as error:
    raise ImportError(
        f"the report needs {error.name!r}: pip install torchrl-osr[examples]"
    ) from error

PAGE = "report.html"
MARKS = {"better": "▲ ", "worse": "▼ ", "not told apart": "= "}


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


class Picture(NamedTuple):
    """A figure of the page.

    Attributes:
        name: of its file, without the ending.
        content: of the PNG file.
        description: what one would see.
        caption: how to read it.
    """

    name: str
    content: bytes
    description: str
    caption: str

    @property
    def source(self) -> str:
        """The PNG file as an address."""
        return f"data:image/png;base64,{base64.b64encode(self.content).decode('ascii')}"


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
    together = [each for each in main if each.data == ALL_DATA]
    suites = [_suite(tables, suite, reference) for suite in tables.suites]
    content = {
        "tables": tables,
        "reference": reference,
        "command": command,
        "num_resamples": NUM_RESAMPLES,
        "min_seeds": MIN_SEEDS,
        "verdict": verdict(main, reference),
        "together": _difference_table(together),
        "by_data": _difference_table(
            [each for each in main if each.data != ALL_DATA]
        ),
        "mind": _pairing_notes(main, reference),
        "differences": _differences(main, reference),
        "notes": comparison_notes(tables),
        "curves": _curves(tables),
        "scores": _score_table(tables),
        "profiles": _profiles(tables),
        "means": _means(tables),
        "mean_table": _mean_table(tables),
        "suites": suites,
        "published": _published(tables.runs),
        "paper": published,
        "coverage": _coverage(tables),
        "every_run": _every_run(tables.runs),
    }
    folder.mkdir(parents=True, exist_ok=True)
    pictures = [content[key] for key in ("differences", "curves", "profiles", "means")]
    pictures += [each for suite in suites for each in suite["pictures"]]
    for picture in filter(None, pictures):
        write_atomically(folder / f"{picture.name}.png", picture.content)
    environment = Environment(
        loader=PackageLoader("torchrl_osr.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"groups": groups, "slug": slug}
    path = folder / PAGE
    write_atomically(path, environment.get_template("page.html.j2").render(content))
    return path


def groups(frame: pd.DataFrame) -> list[tuple[str, list[tuple[str, Sequence[Any]]]]]:
    """Return a table's rows with their names, below the title of each outer index."""
    rows = [
        (index if isinstance(index, tuple) else ("", index), cells)
        for index, cells in zip(
            frame.index, frame.itertuples(index=False, name=None), strict=True
        )
    ]
    titles = dict.fromkeys(title for (title, _), _ in rows)
    return [
        (title, [(name, cells) for (of, name), cells in rows if of == title])
        for title in titles
    ]


def slug(name: str) -> str:
    """Return a name's letters and digits, fit for files and links."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower() or "unnamed"


def _cells(episodes: pd.DataFrame) -> Iterable[tuple[tuple[str, str], pd.DataFrame]]:
    """Return the rows of each data set and method, in their order."""
    found: Iterable[tuple[tuple[str, str], pd.DataFrame]]
    found = episodes.groupby(["data", "method"], sort=False)
    return found


def _by_method(episodes: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the rows of each method, in their order."""
    return dict(iter(episodes.groupby("method", sort=False)))


def _frame(rows: Mapping[Any, Mapping[str, Any]]) -> pd.DataFrame:
    """Return a table of rows by method, or by data set and method."""
    frame = pd.DataFrame(list(rows.values()), dtype=object).fillna("")
    frame.index = pd.Index(list(rows), tupleize_cols=False)
    return frame


def _cell(each: Estimate | None, unit: str = "", missing: str = "not defined") -> Cell:
    """Return an estimate with its interval below."""
    if each is None:
        return Cell(missing, kind="none")
    return Cell(decimal(each.mean) + unit, each.interval())


def _curves(tables: RunTables) -> Picture:
    """Return the learning curves."""
    panels = []
    for data in tables.data:
        rows = tables.episodes[tables.episodes["data"] == data]
        known = {run.data_score for run in tables.runs if run.data == data} - {None}
        bands = {m: score_curve(group) for m, group in _by_method(rows).items()}
        thousands = {m: band._replace(x=band.x / 1000) for m, band in bands.items()}
        levels = sorted({round(float(score), 1) for score in known if score is not None})
        panels.append(Panel(data, thousands, levels=levels))
    figure = draw_panels(
        panels, tables.methods, xlabel="thousand gradient steps",
        ylabel="normalised score",
    )  # fmt: skip
    return Picture(
        "curves",
        png(figure),
        "Normalised score over gradient steps, for each data set",
        "Line: mean over seeds. Band: its 95 % bootstrap interval over seeds; none where "
        "there is one seed. Dotted: mean score of the data's episodes. 0 is D4RL's "
        "random policy, 100 its expert.",
    )


def _score_table(tables: RunTables) -> pd.DataFrame:
    """Return the undisturbed scores, by data set and method."""
    rows, counts = {}, set()
    cells = tables.cells()
    for (data, method), group in _cells(undisturbed(tables.episodes)):
        runs = cells[data, method]
        counts.add(min(NUM_RECENT, group["step"].nunique()))
        known = runs[0].data_score
        rows[data, method] = {
            "seeds": f"{len(runs)} ({', '.join(str(run.seed) for run in runs)})",
            "steps": f"{runs[0].steps:,}",
            "last": _cell(estimate(by_run(recent(group, 1)))),
            "recent": _cell(estimate(by_run(recent(group)))),
            "data": "unknown" if known is None else decimal(known),
        }
    number = " or ".join(str(count) for count in sorted(counts))
    return _frame(rows).rename(columns={"recent": f"mean of the last {number}"})


def _complete(tables: RunTables) -> dict[str, pd.DataFrame]:
    """Return the rows of each method that has runs on all data sets."""
    found = _by_method(tables.episodes)
    everywhere = len(tables.data)
    return {m: rows for m, rows in found.items() if rows["data"].nunique() == everywhere}


def _profiles(tables: RunTables) -> Picture | None:
    """Return the performance profiles of the methods that have all data sets."""
    there = _complete(tables)
    if not there:
        return None
    thresholds = thresholds_of(tables.episodes)
    runs = {m: run_profile(rows, thresholds) for m, rows in there.items()}
    single = {m: episode_profile(rows, thresholds) for m, rows in there.items()}
    panels = [
        Panel("runs (mean of the last evaluations)", runs),
        Panel("single episodes of the last evaluations", single),
    ]
    figure = draw_panels(
        panels, list(there), xlabel="normalised score τ", ylabel="share above τ",
        sharey=True,
    )  # fmt: skip
    return Picture(
        "profiles",
        png(figure),
        "Share of runs and of episodes above each score",
        "Performance profiles (Agarwal et al., 2021): higher is better, and lines that "
        "cross rank nobody. Pointwise 95 % bands: runs are resampled within their data "
        "set; on the right episodes, too, and every data set counts the same. No band "
        "on the left where there is one seed.",
    )


def _means(tables: RunTables) -> Picture:
    """Return the interquartile means as a figure."""
    found = {m: iqm(rows) for m, rows in _by_method(tables.episodes).items()}
    figure = draw_intervals(found, "interquartile mean of the normalised score")
    return Picture(
        "iqm",
        png(figure),
        "Interquartile mean of each method with its interval",
        f"Interquartile mean of all runs' means of the last {NUM_RECENT} evaluations, or "
        "fewer, with its 95 % interval by stratified bootstrap: runs are resampled within "
        "their data set, or, for methods with one seed on some data set, the episodes of "
        "each run.",
    )


def _mean_table(tables: RunTables) -> pd.DataFrame:
    """Return the interquartile means, by method."""
    return _frame(
        {
            method: {
                "data sets": f"{rows['data'].nunique()} of {len(tables.data)}",
                "runs": str(rows["run"].nunique()),
                "IQM": _cell(iqm(rows)),
            }
            for method, rows in _by_method(tables.episodes).items()
        }
    )


def _suite(tables: RunTables, suite: str, reference: str) -> dict[str, Any]:
    """Return tables and figures of one suite."""
    rows = tables.episodes[tables.episodes["suite"] == suite]
    levels = disturbances(rows, suite)
    found = {key: disturbed(group, suite) for key, group in _cells(rows)}
    pictures, strengths, ways = [], [], []
    for data in dict.fromkeys(data for data, _ in found):
        here = {m: each for (of, m), each in found.items() if of == data}
        title = f"{data}, suite {suite}"
        pictures.append(_strengths(here, levels, title))
        strengths.append((pictures[-1], _area_table(here, levels), title))
        back = _ways_back(tables, rows[rows["data"] == data], suite, levels)
        if back:
            both = [_distances(back, title), _recovered(back, title)]
            pictures += both
            ways.append((both, _way_table(back), title))
    differences = compare_all(tables, reference, suite_quantities(tables, suite))
    return {
        "name": suite,
        "scores": _frame({key: _suite_row(each) for key, each in found.items()}),
        "strengths": strengths,
        "ways_back": ways,
        "differences": _difference_table(differences),
        "pictures": pictures,
    }


def _suite_row(found: Disturbed) -> dict[str, Any]:
    """Return a method's scores under a suite, with the decrease below."""
    row: dict[str, Any] = {"seeds": str(found.seeds), "clean": _cell(found.clean)}
    for name, score in found.scores.items():
        lost = found.decreases[name]
        small = "% of a clean score not above 0"
        if lost is not None:
            small = f"{decimal(lost.mean)} % {lost.interval()}"
        row[name] = Cell(str(score), small)
    return row


def _strengths(
    found: Mapping[str, Disturbed], levels: pd.DataFrame, title: str
) -> Picture:
    """Return the share of the clean score against the strength of each series."""
    panels = []
    for series, group in levels.groupby("series", sort=False):
        bands = {}
        for method, each in found.items():
            known = [
                (place, each.decreases[name])
                for place, name in enumerate(group.index)
            ]
            points = [
                (place, 100 - lost.mean, 100 - lost.high, 100 - lost.low)
                for place, lost in known
                if lost is not None
            ]
            if points:
                bands[method] = Band(*np.array(points).T, over="seeds")
        ticks = [f"{strength:g}" for strength in group["strength"]]
        panels.append(Panel(str(series), bands, levels=[100], ticks=ticks))
    figure = draw_panels(
        panels, list(found), xlabel="strength", ylabel="% of the clean score", per_row=3,
        sharey=True,
    )  # fmt: skip
    return Picture(
        f"strength-{slug(title)}",
        png(figure),
        f"Share of the clean score over strength, {title}",
        f"{title}. Dotted: nothing lost.",
    )


def _area_table(
    found: Mapping[str, Disturbed], levels: pd.DataFrame
) -> pd.DataFrame | None:
    """Return the area under each curve of two strengths or more; nothing if none is."""
    wide = {
        str(series): group["strength"]
        for series, group in levels.groupby("series", sort=False)
        if group["strength"].nunique() > 1
    }
    if not wide:
        return None
    return _frame(
        {
            method: {name: _cell(area(each, of)) for name, of in wide.items()}
            for method, each in found.items()
        }
    )


Ways = Mapping[str, Mapping[str, WayBack | None]]
"""By disturbance and method."""


def _ways_back(
    tables: RunTables, episodes: pd.DataFrame, suite: str, levels: pd.DataFrame
) -> Ways:
    """Return the ways back on one data set, of each disturbance that ends."""
    distances = dict(iter(tables.distances.groupby(["data", "method"])))
    return {
        str(name): {
            method: way_back(group, distances[data, method], suite, str(name))
            for (data, method), group in _cells(episodes)
        }
        for name in levels.index[levels["transient"]]
    }


def _distances(back: Ways, title: str) -> Picture:
    """Return the distance to the data after each disturbance."""
    panels = [
        Panel(
            name,
            {m: each.distance for m, each in ways.items() if each and each.distance},
            {
                m: each.undisturbed_distance
                for m, each in ways.items()
                if each and each.undisturbed_distance
            },
            levels=[1],
        )
        for name, ways in back.items()
    ]
    figure = draw_panels(
        panels, list(next(iter(back.values()))), xlabel="steps after the disturbance",
        ylabel="distance to the data", per_row=3,
    )  # fmt: skip
    return Picture(
        f"distance-{slug(title)}",
        png(figure),
        f"Distance to the data after each disturbance, {title}",
        f"{title}: mean distance to the nearest data, in units of the data's own 95 % "
        "quantile (horizontal line). Dotted: the same episodes undisturbed. Bands: 95 %, "
        "over seeds.",
    )


def _recovered(back: Ways, title: str) -> Picture:
    """Return the share of episodes that recovered after each disturbance."""
    panels = [
        Panel(name, {m: each.recovered for m, each in ways.items() if each})
        for name, ways in back.items()
    ]
    figure = draw_panels(
        panels, list(next(iter(back.values()))), xlabel="steps after the disturbance",
        ylabel="share recovered", per_row=3, sharey=True,
    )  # fmt: skip
    return Picture(
        f"recovered-{slug(title)}",
        png(figure),
        f"Share of the disturbed episodes that recovered, {title}",
        f"{title}: share of the disturbed episodes that have been back within the data's "
        "95 % quantile. Bands: 95 %, over seeds and episodes.",
    )


def _way_table(back: Ways) -> pd.DataFrame:
    """Return who was disturbed, who stood it, who came back and what it cost."""
    return _frame(
        {(name, m): _way_row(each) for name, ways in back.items()
         for m, each in ways.items()}
    )  # fmt: skip


def _way_row(each: WayBack | None) -> dict[str, Any]:
    """Return a method's way back after one disturbance."""
    if each is None:
        return {"disturbed": "none"}
    mean, low, high = (_share(float(line[-1])) for line in each.recovered[1:4])
    median = "over half never" if each.median is None else f"{each.median:g}"
    return {
        "disturbed": f"{_share(each.reached)} of {each.episodes}",
        "stood at its end": _share(each.stood),
        "stood later": _share(each.alive_after),
        "(undisturbed)": _share(each.undisturbed_alive),
        "recovered": Cell(mean, f"[{low}, {high}]"),
        "median steps": median,
        "score lost": _cell(each.decrease, " %", "% of a clean score not above 0"),
    }


def _share(value: float | None) -> str:
    """Return a share in percent."""
    return "not known" if value is None else f"{100 * value:.0f} %"


def _differences(found: Sequence[Difference], reference: str) -> Picture | None:
    """Return the figure of all differences; nothing if there is not one pair."""
    paired = [each for each in found if each.estimate is not None]
    if not paired:
        return None
    return Picture(
        "differences",
        png(draw_differences(paired, reference)),
        f"Differences from {reference} with their intervals, by data set",
        f"Each method less {reference}, with 95 % intervals. Blue: better. Orange: "
        f"worse. Hollow: not told apart. Grey: no verdict, fewer than {MIN_SEEDS} seeds.",
    )


def _difference_table(found: Sequence[Difference]) -> pd.DataFrame | None:
    """Return differences by data set and method; nothing if there are none."""
    rows: dict[tuple[str, str], dict[str, Cell]] = {}
    for data in dict.fromkeys(each.data for each in found):
        for each in found:
            if each.data == data:
                row = rows.setdefault((data, each.method), {})
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
            notes.append(f"{where} are not paired in {each.quantity.name}: {each.note}.")
        elif each.note and each.data != ALL_DATA:
            notes.append(f"{where}: {each.note}.")
    return list(dict.fromkeys(notes))


def _published(runs: Sequence[Run]) -> pd.DataFrame | None:
    """Return the paper's own numbers in the environments of the runs."""
    envs = list(dict.fromkeys(run.env for run in runs))
    printed = published.TABLE[published.TABLE.index.get_level_values("env").isin(envs)]
    rows = {
        (f"{env}, D4RL medium-expert", method): {
            name: Cell(f"{row[name, 'score']}", f"{row[name, 'decrease']} %")
            for name in published.DISTURBANCES
        }
        for (env, method), row in printed.iterrows()
    }
    return _frame(rows) if rows else None


def _coverage(tables: RunTables) -> pd.DataFrame:
    """Return the seeds of each method on each data set."""
    cells = tables.cells()
    return _frame(
        {
            method: {
                data: f"{', '.join(str(run.seed) for run in cells[data, method])} "
                f"({cells[data, method][0].steps:,})"
                if (data, method) in cells
                else "none"
                for data in tables.data
            }
            for method in tables.methods
        }
    )


def _every_run(runs: Sequence[Run]) -> pd.DataFrame:
    """Return where each run comes from."""
    return _frame(
        {
            run.folder: {
                "method": run.method,
                "data": run.data,
                "seed": str(run.seed),
                "steps": f"{run.steps:,}",
                "device": f"{run.config['trainer.device']}, threads: "
                f"{run.config['trainer.num_threads']}",
                "versions": ", ".join(f"{k} {v}" for k, v in run.versions.items())
                or "not recorded",
                "overrides": "not recorded"
                if run.overrides is None
                else " ".join(run.overrides) or "none",
            }
            for run in runs
        }
    )
