"""What a reader must know before runs are compared: what is not alike among them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from torchrl_osr.report.methods import METHOD, comparable, describe
from torchrl_osr.report.runs import NOT_RECORDED, Run


def methods_of(runs: Sequence[Run]) -> list[str]:
    """Return the methods, in the order of their first runs."""
    return list(dict.fromkeys(run.method for run in runs))


def data_of(runs: Sequence[Run]) -> list[str]:
    """Return the data sets, in the order of their first runs."""
    return list(dict.fromkeys(run.data for run in runs))


def cells(runs: Sequence[Run]) -> dict[tuple[str, str], list[Run]]:
    """Return the runs of each data set and method: those that may be averaged."""
    found: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        found[run.data, run.method].append(run)
    return dict(found)


def mixed_versions(runs: Sequence[Run]) -> bool:
    """Return whether the runs come from different versions, or some do not say."""
    return len({tuple(sorted(run.versions.items())) for run in runs}) > 1


def comparison_notes(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for everything that makes a comparison less than fair.

    Args:
        runs: all of the report, with their methods' names.
    """
    return [
        *_version_notes(runs),
        *_setting_notes(runs),
        *_seed_notes(runs),
        *_coverage_notes(runs),
    ]


def _version_notes(runs: Sequence[Run]) -> list[str]:
    """Say which package came in which versions."""
    packages = sorted({package for run in runs for package in run.versions})
    notes = []
    for package in packages:
        by_version = _by_value(
            runs, [run.versions.get(package, NOT_RECORDED) for run in runs]
        )
        if len(by_version) > 1:
            parts = [f"{version}: {_names(each)}" for version, each in by_version]
            notes.append(f"Mixed versions of {package}. {'; '.join(parts)}.")
    silent = [run for run in runs if not run.versions]
    if silent and not packages:
        notes.append("No run has its versions recorded.")
    return notes


def _setting_notes(runs: Sequence[Run]) -> list[str]:
    """Say where rivals on one data set differ in more than their method."""
    notes = []
    for data in data_of(runs):
        rivals = [run for run in runs if run.data == data]
        facts = [
            comparable(run) | {"data's own score": run.known_data_score}
            for run in rivals
        ]
        # A preset changes many keys along the same line between runs: one sentence.
        lines: dict[tuple[str, ...], list[list[str]]] = defaultdict(list)
        for key in dict.fromkeys(key for each in facts for key in each):
            texts = [describe(key, each) for each in facts]
            if len(set(texts)) > 1 and not key.startswith(METHOD):
                line = tuple(str(texts.index(text)) for text in texts)
                lines[line].append(texts)
        for line, keys in lines.items():
            parts = [
                f"{_names(each)}: {', '.join(texts[int(first)] for texts in keys)}"
                for first, each in _by_value(rivals, line)
            ]
            notes.append(f"{data}: different settings. {'; '.join(parts)}.")
    return notes


def _seed_notes(runs: Sequence[Run]) -> list[str]:
    """Say where rivals have different seeds, or only one."""
    notes = []
    for data in data_of(runs):
        seeds = {
            method: tuple(sorted(run.seed for run in group))
            for (where, method), group in cells(runs).items()
            if where == data
        }
        by_seeds = _by_value(list(seeds), list(seeds.values()))
        if len(by_seeds) > 1:
            parts = [
                f"{', '.join(map(str, each))} ({', '.join(names)})"
                for each, names in by_seeds
            ]
            notes.append(f"{data}: methods have different seeds: {'; '.join(parts)}.")
    if max(len(group) for group in cells(runs).values()) == 1:
        notes.append(
            "Every method has one seed a data set: intervals are over episodes of that "
            "one training and say nothing about another."
        )
    return notes


def _coverage_notes(runs: Sequence[Run]) -> list[str]:
    """Say which methods lack a data set."""
    names, found = data_of(runs), cells(runs)
    notes = []
    for method in methods_of(runs):
        missing = [data for data in names if (data, method) not in found]
        if missing:
            notes.append(
                f"{method} has no run on {', '.join(missing)}: its mean over data sets "
                "is of fewer."
            )
    return notes


def _by_value(items: Sequence[Any], values: Sequence[Any]) -> list[Any]:
    """Return pairs of a value and the items that have it."""
    found: dict[Any, list[Any]] = defaultdict(list)
    for item, value in zip(items, values, strict=True):
        found[value].append(item)
    return list(found.items())


def _names(runs: Sequence[Run]) -> str:
    """Return which runs these are: their methods, and how many."""
    names = methods_of(runs)
    few = ", ".join(names) if len(names) <= 3 else f"{len(names)} methods"
    return f"{few} ({len(runs)} run{'s' if len(runs) > 1 else ''})"
