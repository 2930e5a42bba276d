"""The report's section on differences between methods, in words and in tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_osr.report.checks import methods_of
from torchrl_osr.report.figures import Styles
from torchrl_osr.report.figures_paired import draw_differences
from torchrl_osr.report.html import (
    Cell,
    Row,
    bullets,
    details,
    figure,
    paragraph,
    side_by_side,
    table,
)
from torchrl_osr.report.notes import EPISODES_MARK
from torchrl_osr.report.paired import (
    ALL_DATA,
    Comparison,
    compare,
)
from torchrl_osr.report.quantities import (
    Quantity,
    level_quantities,
    quantities,
)
from torchrl_osr.report.robustness import suites_of
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import decimal

MARKS = {"better": "▲", "worse": "▼", "not told apart": "=", "not paired": ""}


def paired_section(
    runs: Sequence[Run], reference: str, styles: Styles, folder: Path
) -> str:
    """Return differences of every method from the reference.

    Args:
        runs: all of the report.
        reference: a method's name.
        styles: of the methods.
        folder: where the figure is written to.
    """
    if methods_of(runs) == [reference]:
        return paragraph(f"There is nothing to compare with {reference}.")
    main = quantities(runs)
    found = _compare_all(runs, reference, main)
    together = [each for each in found if each.data == ALL_DATA]
    single = [each for each in found if each.data != ALL_DATA]
    parts = [
        paragraph(
            f"Reference: {reference}. Episodes are matched by data set, training seed, "
            "checkpoint and episode seed; the intervals (95 %) resample seeds, then "
            "episodes. Better and worse: the interval leaves out 0; else the two are "
            "not told apart. Points lost are those between the clean score and the "
            "mean under all disturbances of a suite; fewer are better.",
            f"These are {len(found)} comparisons: of so many, one in twenty would find "
            "a difference where there is none, and with few seeds more.",
        ),
        _picture(found, main, reference, styles, folder),
        _sentences(together or single, reference),
        details("Data set by data set", _sentences(single, reference))
        if together
        else "",
        _table(
            found,
            main,
            f"Points of score, method less {reference} [95 % interval]. "
            f"{EPISODES_MARK}",
        ),
    ]
    for suite in suites_of(runs):
        levels = level_quantities(runs, suite)
        parts += [
            _table(
                _compare_all(runs, reference, block),
                block,
                f"Score under {suite}, disturbance by disturbance, method less "
                f"{reference}. {EPISODES_MARK}",
            )
            for block in side_by_side(levels)
        ]
    return "".join(parts)


def _picture(
    found: Sequence[Comparison],
    wanted: Sequence[Quantity],
    reference: str,
    styles: Styles,
    folder: Path,
) -> str:
    """Return the figure; nothing if there is not one pair."""
    if all(each.difference is None for each in found):
        return ""
    path = folder / "differences.png"
    return figure(
        draw_differences(found, wanted, styles, reference, path),
        f"Differences from {reference} with their intervals, by data set",
        f"Each method less {reference}. Filled: better or worse. Hollow: not told "
        "apart. Pale: the interval is over episodes, for want of seeds.",
    )


def sentence(each: Comparison, reference: str) -> str:
    """Return a comparison in plain words."""
    names = f"{each.data}, {each.quantity.name}: {each.method}"
    if each.difference is None:
        return f"{names} and {reference} are not paired: {each.note}."
    told = each.verdict != "not told apart"
    verb = f"is {each.verdict} than" if told else "is not told apart from"
    mean, low, high, over = each.difference
    runs = f"{each.seeds} pair{'s' if each.seeds > 1 else ''} of runs"
    of_one = ", interval over episodes" if over == "episodes" else ""
    note = f" Mind: {each.note}." if each.note else ""
    return (
        f"{names} {verb} {reference}: {decimal(mean, '+')} points "
        f"[{decimal(low, '+')}, {decimal(high, '+')}], {runs}{of_one}.{note}"
    )


def _sentences(found: Sequence[Comparison], reference: str) -> str:
    """Return a list of sentences."""
    return bullets(Cell(sentence(each, reference), kind=_kind(each)) for each in found)


def _compare_all(
    runs: Sequence[Run], reference: str, wanted: Sequence[Quantity]
) -> list[Comparison]:
    """Return every method's comparisons."""
    return [
        each
        for method in methods_of(runs)
        if method != reference
        for quantity in wanted
        for each in compare(runs, method, reference, quantity)
    ]


def _table(
    found: Sequence[Comparison], wanted: Sequence[Quantity], caption: str
) -> str:
    """Return comparisons with a row for each method and a column for each quantity."""
    by_place = {(each.data, each.method, each.quantity.name): each for each in found}
    data_sets = dict.fromkeys(each.data for each in found if each.data != ALL_DATA)
    if any(each.data == ALL_DATA for each in found):
        data_sets[ALL_DATA] = None
    groups: list[tuple[str, list[Row]]] = []
    for data in data_sets:
        methods = dict.fromkeys(each.method for each in found if each.data == data)
        rows: list[Row] = [
            [m, *(_cell(by_place.get((data, m, q.name))) for q in wanted)]
            for m in methods
        ]
        groups.append((data, rows))
    return table(["method", *(each.name for each in wanted)], groups, caption)


def _cell(each: Comparison | None) -> Cell:
    """Return a difference with its mark."""
    if each is None or each.difference is None:
        return Cell("not paired" if each else "", kind="none")
    value = f"{MARKS[each.verdict]} {decimal(each.difference.mean, '+')}"
    return Cell(value, each.difference.interval, _kind(each))


def _kind(each: Comparison) -> str:
    """Return the class of a verdict."""
    return each.verdict if each.verdict in ("better", "worse") else "none"
