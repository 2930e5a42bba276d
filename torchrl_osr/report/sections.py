"""The report's sections on undisturbed scores, and on where everything comes from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_osr.evaluation import NUM_RECENT
from torchrl_osr.report.checks import (
    cells,
    data_of,
    methods_of,
    mixed_versions,
)
from torchrl_osr.report.figures import (
    Styles,
    draw_curves,
    draw_means,
    draw_profiles,
)
from torchrl_osr.report.files import LeftOut
from torchrl_osr.report.html import (
    Cell,
    Group,
    Row,
    bullets,
    details,
    figure,
    paragraph,
    table,
    warning,
)
from torchrl_osr.report.notes import EPISODES_MARK, VERSIONS_MARK
from torchrl_osr.report.runs import NOT_RECORDED, Run
from torchrl_osr.report.scores import (
    coverage,
    interquartile_means,
    last_score,
    recent_score,
)


def label(method: str, runs: Sequence[Run]) -> str:
    """Return a row's title, with a mark where its runs have different versions."""
    return f"{method} †" if mixed_versions(runs) else method


def curves_section(runs: Sequence[Run], styles: Styles, folder: Path) -> str:
    """Return learning curves."""
    single = sorted({method for (_, method), g in cells(runs).items() if len(g) == 1})
    over = "mean over seeds with its 95 % bootstrap interval over seeds"
    if single:
        over += f" (over episodes where there is one seed: {', '.join(single)})"
    return figure(
        draw_curves(runs, styles, folder / "curves.png"),
        "Normalised score over gradient steps, a panel for each data set",
        f"Line and band: {over}. Dotted: mean score of the data's episodes. 0 is "
        "D4RL's random policy, 100 its expert.",
    )


def clean_section(runs: Sequence[Run]) -> str:
    """Return the table of last and recent scores."""
    groups: list[Group] = []
    for data in data_of(runs):
        rows: list[Row] = [
            [
                label(method, group),
                f"{len(group)} ({', '.join(str(run.seed) for run in group)})",
                f"{group[0].steps:,}",
                str(last_score(group)),
                str(recent_score(group)),
                group[0].known_data_score,
            ]
            for (where, method), group in cells(runs).items()
            if where == data
        ]
        groups.append((data, rows))
    return table(
        ["method", "seeds", "steps", "last", f"mean of the last {NUM_RECENT}", "data"],
        groups,
        "Normalised score: mean over seeds [95 % interval]. Neighbouring evaluations "
        f"swing, so the mean of the last says more. {EPISODES_MARK} {VERSIONS_MARK}",
    )


def profile_section(runs: Sequence[Run], styles: Styles, folder: Path) -> str:
    """Return performance profiles and interquartile means."""
    means = interquartile_means(runs)
    part = [f"{m} ({coverage(runs, m)})" for m in methods_of(runs) if coverage(runs, m)]
    rows = []
    for method, mean in means.items():
        group = [run for run in runs if run.method == method]
        have = coverage(runs, method) or f"all {len(data_of(runs))}"
        rows.append([label(method, group), have, str(len(group)), str(mean)])
    body = ""
    if len(part) < len(means):
        body += figure(
            draw_profiles(runs, styles, folder / "profiles.png"),
            "Share of runs and of episodes above each score, a line for each method",
            "Performance profiles (Agarwal et al., 2021): higher is better, and lines "
            "that cross rank nobody. Pointwise 95 % bands: runs are resampled within "
            "their data set; on the right episodes, too. On the right every data set "
            "counts the same. No band on the left where there is one seed.",
        )
    return (
        warning("Not in the profiles: methods that lack a data set", part)
        + body
        + figure(
            draw_means(means, styles, folder / "iqm.png"),
            "Interquartile mean of each method with its interval",
            f"Interquartile mean of all runs' means of the last {NUM_RECENT} "
            "evaluations with its 95 % interval by stratified bootstrap: runs are "
            "resampled within their data set, or, for methods with one seed on some "
            "data set, the episodes of each run.",
        )
        + table(
            ["method", "data sets", "runs", "IQM"], [("", rows)],
            f"Means over different data sets cannot be compared. {EPISODES_MARK}",
        )
    )  # fmt: skip


def provenance_section(
    runs: Sequence[Run], left_out: Sequence[LeftOut], command: str
) -> str:
    """Return where the numbers come from, and what was left out."""
    found = cells(runs)
    rows = [
        [method]
        + [
            _seeds(found[data, method]) if (data, method) in found else "none"
            for data in data_of(runs)
        ]
        for method in methods_of(runs)
    ]
    texts = dict.fromkeys(_versions(run) for run in runs)
    versions = {each: str(number + 1) for number, each in enumerate(texts)}
    every: list[Row] = [
        [
            str(run.folder), run.method, run.data, str(run.seed), f"{run.steps:,}",
            _machine(run), versions[_versions(run)], Cell(_overrides(run), kind="wide"),
        ]
        for run in runs
    ]  # fmt: skip
    head = ["folder", "method", "data", "seed", "steps"]
    head += ["hardware", "versions", "overrides"]
    return (
        warning(
            "Left out", [f"{each.path}: {each.reason}" for each in left_out]
        )
        + paragraph(
            f"{len(runs)} finished runs, {len(left_out)} folders or files left out.",
            f"Made by: {command}",
        )
        + bullets(f"Versions {number}: {each}." for each, number in versions.items())
        + table(["seeds (steps)", *data_of(runs)], [("", rows)])
        + details("Every run", table(head, [("", every)]))
    )  # fmt: skip


def _seeds(runs: Sequence[Run]) -> str:
    """Return the seeds of a cell and its steps."""
    return f"{', '.join(str(run.seed) for run in runs)} ({runs[0].steps:,})"


def _versions(run: Run) -> str:
    """Return all versions of a run."""
    return ", ".join(f"{k} {v}" for k, v in run.versions.items()) or NOT_RECORDED


def _overrides(run: Run) -> str:
    """Return what stood on the command line."""
    if run.overrides is None:
        return NOT_RECORDED
    return " ".join(run.overrides) or "none"


def _machine(run: Run) -> str:
    """Return what a run ran on, as far as it says."""
    device = run.config.get("trainer.device", NOT_RECORDED)
    threads = run.config.get("trainer.num_threads")
    parts = [run.hardware, f"device {device}", threads and f"threads: {threads}"]
    return ", ".join(str(part) for part in parts if part)
