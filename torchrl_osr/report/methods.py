"""Methods: which runs may be averaged, what they are called, how fair comparisons are.

Runs are averaged only if their configurations differ in nothing but the seed (and, over
data sets, the data set). Of runs with one name that differ in more, each kind becomes a
method of its own, with the difference in its name.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_osr.report.runs import (
    LeftOut,
    Run,
    RunTables,
    read_each,
    tables_of,
)

IGNORED = (
    "resume",
    "population",
    "logger.",
    "trainer.progress",
    "trainer.num_threads",
    "trainer.nonfinite",
    "trainer.compile",
    "trainer.cudagraph",
    "trainer.log_interval",
    "trainer.checkpoint_interval",
    "trainer.checkpoints_kept",
    "loss.chunk_size",
    "loss.deactivate_vmap",
)
"""Settings that decide how a number is computed, not which."""

IDENTITY = ("seed", "env.", "data.quality", "data.random_share", "data.path")
"""Settings that the report sorts runs by."""

METHOD = ("loss.", "perturbation.", "inverse_dynamics.", "num_random")
"""Settings in which methods differ by intent; all others should be equal."""

NUM_NAMED = 3
"""At most so many differences are in a name."""


def read_runs(paths: Sequence[Path]) -> RunTables:
    """Read all runs in or below the folders and in the tables, and name their methods.

    Args:
        paths: folders of runs, or above them, and tables of runs (``.jsonl.gz``).

    Returns:
        Runs of one method's name may be averaged. What cannot be read, is not finished
        or is there twice is listed as left out.

    Raises:
        FileNotFoundError: if a path does not exist.
        ValueError: if there is no finished run, saying what was left out and why.
    """
    runs, unread = read_each(paths)
    runs, repeated = name_methods(runs)
    left_out = [*unread, *repeated]
    if not runs:
        reasons = "".join(f"\n  {each.path}: {each.reason}" for each in left_out)
        raise ValueError(
            f"no finished run in {', '.join(map(str, paths))}.{reasons}\n"
            "Give folders of examples/offline_osr.py, or a table of such runs."
        )
    return tables_of(name_suites(runs), left_out)


def name_methods(runs: Sequence[Run]) -> tuple[list[Run], list[LeftOut]]:
    """Give methods of one name that differ different names; drop repeated runs.

    Returns:
        One run of each method, data set and seed; the others.
    """
    named: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        named[run.method].append(run)
    kept: dict[tuple[str, str, int], Run] = {}
    left_out = []
    for method, group in named.items():
        kinds = distinctions([comparable(run) for run in group])
        for run, kind in zip(group, kinds, strict=True):
            name = f"{method} ({kind})" if kind else method
            run = replace(run, method=name)
            first = kept.setdefault((name, run.data, run.seed), run)
            if first is not run:
                reason = f"the same run as {first.folder}, which is in the report"
                left_out.append(LeftOut(run.folder, reason))
    return list(kept.values()), left_out


def name_suites(runs: Sequence[Run]) -> list[Run]:
    """Give suites of one name that were played differently different names."""
    named: dict[str, list[int]] = defaultdict(list)
    for index, run in enumerate(runs):
        for suite in run.protocols:
            named[suite].append(index)
    names: list[dict[str, str]] = [{} for _ in runs]
    for suite, places in named.items():
        texts = distinctions([runs[index].protocols[suite] for index in places])
        for index, text in zip(places, texts, strict=True):
            names[index][suite] = f"{suite} ({text})" if text else suite
    return [
        replace(
            run,
            protocols={name[suite]: each for suite, each in run.protocols.items()},
            **{
                table: frame.assign(suite=frame["suite"].map({"": ""} | name))
                for table, frame in (("episodes", run.episodes),
                                     ("distances", run.distances))
            },
        )
        for run, name in zip(runs, names, strict=True)
    ]  # fmt: skip


def comparable(run: Run) -> dict[str, Any]:
    """Return what must be equal for two runs to be averaged."""
    facts = {
        key: value
        for key, value in run.config.items()
        if not key.startswith((*IGNORED, *IDENTITY))
    }
    return facts | {"evaluated at": run.evaluated_at}


def differing(facts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the entries in which they are not all equal."""
    keys = dict.fromkeys(key for each in facts for key in each)
    return [key for key in keys if len({exact(key, each) for each in facts}) > 1]


def exact(key: str, facts: Mapping[str, Any]) -> str:
    """Return an entry in full, as a text to compare."""
    return repr(facts[key]) if key in facts else "none"


def distinctions(facts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return in few words in which entries each differs from the others.

    Returns:
        A text for each; equal for equal entries, else different. All "" if all are
        equal.
    """
    keys = differing(facts)
    kinds = ["; ".join(exact(key, each) for key in keys) for each in facts]
    shown = sorted(keys, key=lambda key: (key != "trainer.steps", keys.index(key)))
    if "trainer.steps" in shown and "evaluated at" in shown:
        shown.remove("evaluated at")  # the one brings the other with it
    texts = [_few(shown, each) for each in facts]
    if len(set(texts)) < len(set(kinds)):  # what differs did not fit in
        order = list(dict.fromkeys(kinds))
        texts = [
            f"{text}, kind {order.index(kind) + 1}"
            for text, kind in zip(texts, kinds, strict=True)
        ]
    return texts


def in_words(key: str, facts: Mapping[str, Any]) -> str:
    """Return an entry in words."""
    # What is built is known by its name; where it is imported from is no setting.
    name = key.removesuffix("._target_")
    if key not in facts:
        return f"no {name}"
    if key == "trainer.steps":
        return f"{facts[key]:,} steps"
    if key == "evaluated at":
        return f"evaluated {len(facts[key])} times"
    if key in ("levels", "episode seeds"):
        return f"other {key}"
    value = str(facts[key])
    return f"{name}={value.rpartition('.')[2] if name != key else value}"


def _few(keys: Sequence[str], facts: Mapping[str, Any]) -> str:
    """Return the first of some entries in words, and how many more there are."""
    rest = len(keys) - NUM_NAMED
    more = f" and {rest} more" if rest > 0 else ""
    return ", ".join(in_words(key, facts) for key in keys[:NUM_NAMED]) + more


def comparison_notes(tables: RunTables) -> list[str]:
    """Return a sentence for everything that makes a comparison less than fair."""
    return [
        *_version_notes(tables.runs),
        *_setting_notes(tables),
        *_seed_notes(tables),
        *_coverage_notes(tables),
    ]


def _version_notes(runs: Sequence[Run]) -> list[str]:
    """Say which package came in which versions, and of which runs that is unknown."""
    notes = []
    for package in sorted({package for run in runs for package in run.versions}):
        known = [run for run in runs if package in run.versions]
        found = _by_value(known, [run.versions[package] for run in known])
        if len(found) > 1:
            parts = [f"{version}: {_names(each)}" for version, each in found]
            notes.append(f"Mixed versions of {package}. {'; '.join(parts)}.")
    silent = [run for run in runs if not run.versions]
    if silent:
        notes.append(f"No versions are recorded of {_names(silent)}.")
    return notes


def _setting_notes(tables: RunTables) -> list[str]:
    """Say where rivals on one data set differ in more than their method."""
    notes = []
    for data in tables.data:
        rivals = [run for run in tables.runs if run.data == data]
        facts = [
            comparable(run) | {"the data's own score": _known_score(run)}
            for run in rivals
        ]
        keys = [key for key in differing(facts) if not key.startswith(METHOD)]
        kinds = _by_value(rivals, [str([exact(key, f) for key in keys]) for f in facts])
        if keys:
            parts = [
                f"{_names(each)}: {_few(keys, facts[rivals.index(each[0])])}"
                for _, each in kinds
            ]
            notes.append(f"{data}: different settings. {'; '.join(parts)}.")
    return notes


def _seed_notes(tables: RunTables) -> list[str]:
    """Say where rivals have different seeds, or only one."""
    notes = []
    cells = tables.cells()
    for data in tables.data:
        seeds = {
            method: ", ".join(str(seed) for seed in sorted(run.seed for run in group))
            for (where, method), group in cells.items()
            if where == data
        }
        found = _by_value(list(seeds), list(seeds.values()))
        if len(found) > 1:
            parts = [f"{each} ({', '.join(names)})" for each, names in found]
            notes.append(f"{data}: methods have different seeds: {'; '.join(parts)}.")
    if max(map(len, cells.values())) == 1:
        notes.append(
            "Every method has one seed a data set: intervals are over the episodes of "
            "that one training and say nothing about another."
        )
    return notes


def _coverage_notes(tables: RunTables) -> list[str]:
    """Say which methods have no run on a data set."""
    cells, notes = tables.cells(), []
    for method in tables.methods:
        missing = [data for data in tables.data if (data, method) not in cells]
        if missing:
            notes.append(
                f"{method} has no run on {', '.join(missing)}: its mean over data sets "
                "is of fewer."
            )
    return notes


def _known_score(run: Run) -> str:
    return "unknown" if run.data_score is None else f"{run.data_score:.1f}"


def _by_value(items: Sequence[Any], values: Sequence[Any]) -> list[Any]:
    """Return pairs of a value and the items that have it."""
    found: dict[Any, list[Any]] = defaultdict(list)
    for item, value in zip(items, values, strict=True):
        found[value].append(item)
    return list(found.items())


def _names(runs: Sequence[Run]) -> str:
    """Return which runs these are: their methods, and how many."""
    names = list(dict.fromkeys(run.method for run in runs))
    few = ", ".join(names) if len(names) <= 3 else f"{len(names)} methods"
    return f"{few} ({len(runs)} run{'s' if len(runs) > 1 else ''})"
