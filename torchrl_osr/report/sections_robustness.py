"""The report's sections on disturbed episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl_osr.report import published
from torchrl_osr.report.checks import cells, data_of
from torchrl_osr.report.figures import Styles
from torchrl_osr.report.figures_robustness import (
    draw_recoveries,
    draw_strengths,
)
from torchrl_osr.report.html import (
    Cell,
    Group,
    Row,
    details,
    figure,
    heading,
    paper,
    paragraph,
    side_by_side,
    slug,
    table,
)
from torchrl_osr.report.notes import (
    RECOVERY_NOTE,
    STRENGTH_NOTE,
    TABLE_NOTE,
)
from torchrl_osr.report.recovery import (
    Recovery,
    recovery,
    transient_levels,
)
from torchrl_osr.report.robustness import (
    Disturbed,
    area,
    disturbed,
    series_of,
    suite_levels,
    suites_of,
    with_suite,
)
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import Estimate, decimal
from torchrl_osr.report.sections import label

Results = Mapping[str, Mapping[str, Disturbed]]
"""By data set and method."""


def disturbed_results(runs: Sequence[Run], suite: str) -> Results:
    """Return what every method scores under a suite."""
    found: dict[str, dict[str, Disturbed]] = {}
    for (data, method), group in cells(with_suite(runs, suite)).items():
        found.setdefault(data, {})[method] = disturbed(group, suite)
    return found


def table_section(runs: Sequence[Run]) -> str:
    """Return the tables of scores under disturbances, and the paper's own."""
    if not suites_of(runs):
        return paragraph(
            "No run has been disturbed: there is no robustness-<suite>.json beside its "
            "returns."
        )
    parts = []
    for suite in suites_of(runs):
        results = disturbed_results(runs, suite)
        groups = cells(with_suite(runs, suite))
        levels = suite_levels(runs, suite)
        order = [i for indices in series_of(levels).values() for i in indices]
        parts += [heading(f"Suite {suite}"), paragraph(TABLE_NOTE)]
        for block in side_by_side(order):
            body: list[Group] = []
            for data, methods in results.items():
                rows = [
                    _score_row(label(name, groups[data, name]), each, block)
                    for name, each in methods.items()
                ]
                body.append((data, rows))
            parts.append(
                table(["method", "seeds", "clean", *(levels[i].name for i in block)],
                      body)
            )  # fmt: skip
    return "".join(parts) + _paper_table(runs)


def strength_section(runs: Sequence[Run], styles: Styles, folder: Path) -> str:
    """Return the share of the clean score against the strength of each kind."""
    parts = []
    for suite in suites_of(runs):
        for data, results in disturbed_results(runs, suite).items():
            title = f"{data}, suite {suite}"
            path = folder / f"strength-{slug(suite)}-{slug(data)}.png"
            parts.append(
                figure(
                    draw_strengths(results, styles, title, path),
                    f"Share of the clean score over strength, {title}",
                    f"{title}. Dotted: nothing lost.",
                )
            )
            parts.append(_area_table(results, title))
    note = STRENGTH_NOTE if parts else "No run has been disturbed."
    return paragraph(note) + "".join(parts)


def recovery_section(runs: Sequence[Run], styles: Styles, folder: Path) -> str:
    """Return distance and recovery after disturbances that end."""
    parts = []
    for suite in suites_of(runs):
        there = with_suite(runs, suite)
        levels = suite_levels(runs, suite)
        for data in data_of(there):
            groups = {m: g for (d, m), g in cells(there).items() if d == data}
            results = {
                levels[index].name: {
                    method: recovery(group, suite, index)
                    for method, group in groups.items()
                }
                for index in transient_levels(there, suite)
            }
            if not results:
                continue
            title = f"{data}, suite {suite}"
            path = folder / f"recovery-{slug(suite)}-{slug(data)}.png"
            parts.append(
                figure(
                    draw_recoveries(results, styles, title, path),
                    f"Distance to the data and share recovered over steps, {title}",
                    f"{title}. Grey: the data's own 95 % quantile. Dotted, if "
                    "recorded: the same episodes undisturbed.",
                )
            )
            parts.append(details(f"In numbers: {title}", _recovery_table(results)))
    note = RECOVERY_NOTE if parts else "No run was disturbed by anything that ends."
    return paragraph(note) + "".join(parts)


def _score_row(title: str, result: Disturbed, block: Sequence[int]) -> Row:
    """Return a method's scores under some levels."""
    cells = [Cell(str(result.scores[i]), _percent(result.decreases[i])) for i in block]
    clean = Cell(f"{result.clean.mean:.1f}", result.clean.interval)
    return [title, str(result.seeds), clean, *cells]


def _percent(estimate: Estimate | None) -> str:
    """Return a percentage with its interval."""
    if estimate is None:
        return "% of a clean score not above 0"
    return f"{decimal(estimate.mean)} % {estimate.interval}"


def _paper_table(runs: Sequence[Run]) -> str:
    """Return the paper's own numbers, marked as such."""
    groups: list[Group] = []
    for env in dict.fromkeys(run.env for run in runs):
        printed = published.TABLE.get(env, {})
        rows: list[Row] = [
            [method, *(Cell(f"{c.score}", f"{c.decrease} %") for c in cells)]
            for method, cells in printed.items()
        ]
        if rows:
            groups.append((f"{env}, D4RL medium-expert", rows))
    if not groups:
        return ""
    return paper(
        heading("Another data set (D4RL), the paper's own numbers"),
        paragraph(
            f"{published.SOURCE}. Other data, another simulator and another "
            "disturbance: random actions of size 0.001. Four seeds, no intervals "
            f"printed. Score, and below it the decrease. {published.MISPRINTS}"
        ),
        table(["method", *published.LEVELS], groups),
    )


def _area_table(results: Mapping[str, Disturbed], title: str) -> str:
    """Return the area under each curve of two strengths or more; nothing if none is."""
    levels = next(iter(results.values())).levels
    series = series_of(levels)
    wide = [
        name
        for name, each in series.items()
        if len({levels[i].strength for i in each}) > 1
    ]
    if not wide:
        return ""
    rows = []
    for method, result in results.items():
        areas = [area(result, series[name]) for name in wide]
        rows.append([method, *(str(each) if each else "not defined" for each in areas)])
    caption = (
        f"{title}: mean share of the clean score over the range of strengths, in "
        "percent (area under the curve, trapezoid rule)."
    )
    return table(["method", *wide], [("", rows)], caption)


def _recovery_table(results: Mapping[str, Mapping[str, Recovery | None]]) -> str:
    """Return who was disturbed, who stood it, who came back and what it cost."""
    groups: list[Group] = []
    for level, methods in results.items():
        rows: list[Row] = []
        for method, each in methods.items():
            if each is None:
                rows.append([method, "none", *[""] * 6])
                continue
            rows.append(
                [
                    method,
                    f"{_share(each.reached)} of {each.episodes}",
                    _share(each.survived),
                    _share(each.alive_after),
                    _share(each.undisturbed_alive),
                    _recovered(each),
                    "over half never" if each.median is None else f"{each.median:g}",
                    _percent(each.decrease),
                ]
            )
        groups.append((level, rows))
    head = ["method", "disturbed", "stood at its end", "stood later", "(undisturbed)"]
    head += ["recovered", "median steps", "score lost"]
    return table(
        head, groups,
        "Who had fallen before was not disturbed and shows no loss: all columns after "
        "the first are of the disturbed episodes alone. Later: at the end of the "
        "curves; in brackets, the same episodes undisturbed. Recovered: until then. "
        "Median: over those that never recovered, too.",
    )  # fmt: skip


def _recovered(each: Recovery) -> Cell:
    """Return the share that had recovered at the end."""
    mean, low, high = (float(line[-1]) for line in each.recovered[1:4])
    return Cell(_share(mean), f"[{_share(low)}, {_share(high)}]")


def _share(value: float | None) -> str:
    """Return a share in percent."""
    return "not known" if value is None else f"{100 * value:.0f} %"
