"""Write tables.md and draw the figure, from the runs beside this file.

python results/scoreboard/tables.py
"""

from __future__ import annotations

import inspect
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from hydra.utils import get_class
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torchrl_osr.evaluation.recoverable import (
    GROUPS,
    recovered_share,
    saved_difference,
)
from torchrl_osr.report import RunTables, read_runs
from torchrl_osr.report.comparisons import compare, quantities
from torchrl_osr.report.saved import came_back, percent, saved_states
from torchrl_osr.report.scores import Estimate, by_run, estimate, recent

from torchrl_osr._files import write_atomically

HERE = Path(__file__).parent
SUITES = {"oos": "oos", "push": "push", "observation_noise": "noise"}

ARMS = ("osr", "cql_both", "noisy_bc", "td3_bc")
"""What is compared with OSR's twin without a model."""

# On D4RL v2, which are other data, after a hundred times the updates. TD3+BC, IQL and
# ReBRAC: Tarasov et al. 2023 (arXiv 2305.09836, tables 16 and 17), and as quoted there
# CQL, SAC-N and EDAC (An et al. 2021) and RORL (Yang et al. 2022); MOPO: README of
# OfflineRL-Kit; RAMBO, SDC and OSR: their papers.
PUBLISHED = pd.DataFrame(
    {
        "td3_bc": (55.1, 68.0, 45.0, 87.8, 110.4, 89.1),
        "iql": (89.6, 75.4, 42.1, 85.5, 112.1, 92.7),
        "cql": (86.3, 76.8, 45.3, 96.9, 109.1, 95.0),
        "sac_10": (101.8, 78.7, 63.9, 110.1, 116.7, 107.1),
        "edac_10": (101.0, 87.1, 61.3, 110.7, 114.7, 106.3),
        "rorl": (102.8, 90.4, 61.9, 112.7, 121.2, 107.8),
        "rebrac": (98.1, 77.3, 51.0, 107.0, 111.6, 101.1),
        "mopo": (92.7, 85.9, 72.1, 74.6, 108.2, 83.6),
        "rambo": (96.6, 85.0, 68.9, 83.3, 68.3, 93.7),
        "sdc": (48.2, 30.3, 47.3, 112.9, 105.3, 101.3),
        "osr": (96.7, 87.9, 46.8, 113.1, 114.3, 94.7),
    },
    [
        f"{env} {data}"
        for data in ("medium-replay", "medium-expert")
        for env in ("hopper", "walker2d", "halfcheetah")
    ],
)


def scores(tables: RunTables) -> pd.DataFrame:
    """A row for each run: its undisturbed score, and those under each suite."""
    last, all_ = recent(tables.episodes), tables.episodes
    keys = ["data", "method", "run", "seed"]
    found = {"undisturbed": last.groupby(keys)["score"].mean()}
    for suite in SUITES:
        rows = all_[(all_["suite"] == suite) & (all_["disturbance"] != "")]
        found[suite] = rows.groupby(keys)["score"].mean()
    return pd.DataFrame(found).reset_index()


def table(tables: RunTables, data: str, saved: dict[tuple[str, str], Estimate]) -> str:
    """Markdown: the methods on one data set, best undisturbed score first."""
    rows = []
    for method in tables.methods:
        mine = tables.episodes.query("data == @data and method == @method")
        if mine.empty:
            continue
        cells = [str(estimate(by_run(recent(mine))))]
        for suite in SUITES:
            under = mine[(mine["suite"] == suite) & (mine["disturbance"] != "")]
            cells.append(str(estimate(by_run(under))))
        cells.append(str(saved.get((method, data), "")))
        steps = tables.runs.query("data == @data and method == @method")["steps"].max()
        quoted = str(PUBLISHED.loc[data].get(method, ""))
        seeds = mine["seed"].nunique()
        mean = recent(mine)["score"].mean()
        rows.append((mean, [f"`{method}`", str(seeds), f"{steps:,}", *cells, quoted]))
    suites = *SUITES.values(), "recoverable %"
    head = ["method", "seeds", "updates", "undisturbed", *suites, "published"]
    lines = [head, ["---"] * len(head), *(cells for _, cells in sorted(rows)[::-1])]
    return markdown(lines)


def overview(
    found: pd.DataFrame, saved: dict[tuple[str, str], Estimate], quality: str
) -> str:
    """Markdown: means over the data sets of a quality, of whom has three seeds on each.

    That of all, ``""``, feeds the README's table of methods; ``found`` are the runs'
    :func:`scores`.
    """
    means = found.assign(disturbed=lambda rows: rows[list(SUITES)].mean(axis=1))
    means = means[means["data"].str.endswith(quality)]
    seeds = means.groupby(["method", "data"])["seed"].nunique().unstack()
    means = means.groupby(["method", "data"])[["undisturbed", "disturbed"]].mean()
    means["recoverable %"] = pd.Series({key: each.mean for key, each in saved.items()})
    means = means.groupby("method").mean()[(seeds >= 3).all(axis=1)]
    head = ["method", *means]
    rows = [
        [f"`{method}`", *(f"{each:.1f}" for each in row)]
        for method, row in means.sort_values("undisturbed").iloc[::-1].iterrows()
    ]
    return markdown([head, ["---"] * len(head), *rows])


def differences(tables: RunTables) -> str:
    """Markdown: OSR less each other method, over all data sets that both have."""
    # All have as many evaluations, after different numbers of updates.
    rank = tables.episodes.groupby(["data", "method", "suite"])["step"].rank("dense")
    ranked = replace(tables, episodes=tables.episodes.assign(step=rank))
    wanted = [each for each in quantities(ranked) if "lost" not in each.name]
    head = ["less", "seeds", *(each.name for each in wanted)]
    rows = [head, ["---"] * len(head)]
    for method in tables.methods:
        if method == "osr":
            continue
        found = [compare(ranked, "osr", method, each) for each in wanted]
        if len(found[0]) == len(tables.data) + 1:  # and the mean over them
            cells = [str(each[-1].estimate) for each in found]
            rows.append([f"`{method}`", str(found[0][-1].seeds), *cells])
    return markdown(rows)


def ablation(tables: RunTables) -> str:
    """Markdown: what the arms of OSR's ablation save more than its twin, and R."""
    twin = "cql_noisy_bc"
    rows = [["data", "arm", "seeds", f"points more than `{twin}`", "R %"], ["---"] * 5]
    for data, _, of_each, back in came_back(tables):
        hard = of_each["group"] == GROUPS[-1]
        walk, table = of_each["walk"][hard], back.loc[:, hard]
        for arm in ARMS:
            ours, theirs = table.loc[arm].align(table.loc[twin], "inner", axis=0)
            shares = (
                saved_difference(ours, theirs, walk),
                recovered_share(ours, theirs, walk),
            )
            cells = [str(percent(share, len(ours))) for share in shares]
            rows.append([data, f"`{arm}`", str(len(ours)), *cells])
    return markdown(rows)


def markdown(rows: list[list[str]]) -> str:
    """A table of these rows, the second of which is a line."""
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def lines(tables: RunTables) -> str:
    """Markdown: what was typed for each method, its class, and what an update takes."""
    head = [
        "method",
        "typed",
        "class",
        "lines of its file, but for its docstring",
        "ms an update",
        "at the paper's sizes",
    ]
    rows = [head, ["---"] * len(head)]
    measured = json.loads((HERE / "update_ms.json").read_text())
    for _, run in tables.runs.drop_duplicates("method").iterrows():
        typed = run["overrides"].split()
        chosen = [each for each in typed if each.startswith(("loss", "recovery"))]
        loss = get_class(tables.settings.at[run.name, "loss._target_"])
        file = Path(inspect.getfile(loss)).read_text()
        code = len(file.splitlines()) - len(inspect.getdoc(loss).splitlines())
        command = " ".join(chosen) or "loss=osr"
        row = [f"`{run['method']}`", f"`{command}`", f"`{loss.__name__}`"]
        found = [measured[preset].get(run["method"]) for preset in ("quick", "paper")]
        took = ["" if each is None else f"{each:.1f}" for each in found]
        rows.append([*row, str(code), *took])
    return markdown(rows)


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Score undisturbed against score disturbed: a point for each method."""
    data = list(rows["data"].unique())
    wide = 3 if len(data) > 4 else min(2, len(data))
    high = -(-len(data) // wide)  # rounded up
    figure = Figure(figsize=(1 + 4.5 * wide, 3.8 * high), layout="constrained")
    FigureCanvasAgg(figure)
    for number, name in enumerate(data, start=1):
        axes = figure.add_subplot(high, wide, number)
        mine = rows[rows["data"] == name].groupby("method")
        mean = mine[["undisturbed", *SUITES]].mean()
        disturbed = mean[list(SUITES)].mean(axis=1)
        axes.scatter(mean["undisturbed"], disturbed, s=14, color="#0072B2")
        end, top = max(mean["undisturbed"].max(), 1), max(disturbed.max(), 1)
        axes.plot([0, end], [0, end], color="0.8", linewidth=0.8, zorder=0)
        axes.set_ylim(min(disturbed.min(), 0) - 0.05 * top, 1.15 * top)
        # Names in a column, each tied to its point: beside the points they overlap.
        order = disturbed.sort_values().index
        apart = 1.1 * top / 22  # that 23 names fit
        heights: list[float] = []
        for point in disturbed[order[::-1]]:  # as near to the points as names allow
            heights.append(min([point, *(each - apart for each in heights[-1:])]))
        heights = np.maximum(heights[::-1], apart * np.arange(len(order)))
        for method, height in zip(order, heights, strict=True):
            own = "osr" in method
            colour = "#D55E00" if own else "0.25"
            axes.annotate(
                method, (mean["undisturbed"][method], disturbed[method]),
                xytext=(1.2 * end, height), fontsize=7, va="center", color=colour,
                weight="bold" if own else "normal", annotation_clip=False,
                arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.3},
            )  # fmt: skip
        axes.set_title(name, fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("score undisturbed", fontsize=10)
    figure.supylabel("score under disturbance, mean of three suites", fontsize=10)
    figure.savefig(path, dpi=130)


TITLE = """# Scoreboard: the tables

Written by `tables.py`; [README.md](README.md) says what they are of. *updates*: what
two minutes of a core gave beside another run on the same two virtual cores
(`update_ms.json`). Under the suites: mean score over all disturbances. *recoverable*:
percent of the public half's states that the last policy comes back from. *published*:
scores on D4RL v2, other data, after a hundred times the updates; `tables.py` has their
sources. Intervals at 95 %; ²: two seeds, whose interval holds the mean every other
time; ᵉ: one seed, over episodes, or over walks for the recoverable states."""

DIFFERENCES = """Means over all six data sets, paired by seed and episode; seeds and
episodes are resampled. *seeds*: the fewest of a data set; an interval over three is too
narrow to rank anything."""

ABLATION = """What the arms of OSR's ablation save of the recoverable states more than
`cql_noisy_bc`, whose states, noise and updates are OSR's and whose label is the row's
action; R is the share of what that one loses. Seeds and walks are resampled."""

LINES = """*ms an update*: of the preset `quick` and, where it was measured, of
`preset=paper`, whose batches and layers of 256 are those of CORL's files (K = 10);
processor time beside other work."""


def seeds(tables: RunTables, found: pd.DataFrame) -> str:
    """Markdown: how many seeds there are of each method on each data set."""
    runs = found.groupby(["method", "data"]).size()
    head = ["method", *tables.data]
    rows = [head, ["---"] * len(head)]
    for method in tables.methods:
        counts = [runs.get((method, data), 0) for data in tables.data]
        rows.append([f"`{method}`", *(str(each) if each else "" for each in counts)])
    return markdown(rows)


def main() -> None:
    """Write the tables, and draw."""
    tables = read_runs(sorted(HERE.glob("*.jsonl.gz")))
    found = scores(tables)
    saved = {
        (each.method, each.data): each.shares["recoverable"]
        for each in saved_states(tables, tables.methods[0])
    }
    pages = [TITLE, "## Seeds", seeds(tables, found)]
    for data in tables.data:
        pages += [f"## {data}", table(tables, data, saved)]
    for quality in ("", "medium-expert", "medium-replay"):
        title = f"## Means over {quality or 'all six data sets'}"
        pages += [title, overview(found, saved, quality)]
    pages += ["## OSR less each other", DIFFERENCES, differences(tables)]
    pages += ["## Ablation", ABLATION, ablation(tables)]
    pages += ["## Lines", LINES, lines(tables)]
    write_atomically(HERE / "tables.md", "\n\n".join(pages) + "\n")
    draw(found, HERE / "scoreboard.png")


if __name__ == "__main__":
    main()
