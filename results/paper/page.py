"""Write the tables of this folder into the pages that show them.

    python results/paper/page.py

A page marks the place of a table or number with ``<!-- name -->`` and
``<!-- /name -->``. The pages are this folder's README.md and tables.md, that of
results/mazes, the repository's README.md and docs/results.md. Also draws the figures.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from run import (
    ENVS,
    EXPERTS,
    HERE,
    LIMITED,
    MAZES,
    MUJOCO,
    OWN,
    RESULTS,
    SIX,
    TABLES,
    TRIALS,
    folder_name,
    packed,
    updates,
)

sys.path.append(str(RESULTS))
import tables
from tables import differences, estimate, markdown

from torchrl_osr.lab.evaluation.statistics import (
    Estimate,
    decimal,
    recovered_share,
    scores_and_decreases,
    wilson,
)
from torchrl_osr.lab.report.page import COLORS

mpl.use("agg")
import matplotlib.pyplot as plt

ROOT = HERE.parents[1]
NOT_RUN = "not run"
SEEDS = "\N{NO-BREAK SPACE}\N{MULTIPLICATION SIGN}{}"
SOURCES = ("medium-replay", "medium-expert")
TITLES = {
    "cql": "CQL(H)", "iql": "IQL", "mopo": "MOPO", "rambo": "RAMBO", "sdc": "SDC",
    "osr": "OSR", "osr_v": "OSR-v", "td3_bc": "TD3+BC", "rebrac": "ReBRAC",
    "cql_noisy_bc": "CQL + noisy BC", "osr_10": "OSR-10", "sac_10": "SAC-10",
    "edac_10": "EDAC-10", "rorl": "RORL",
}  # fmt: skip
IN_DOCS = {"rim": "RIM", "noisy_bc": "noisy BC"} | {
    name: TITLES[name] for name in ("osr", "cql_noisy_bc", "td3_bc", "cql", "osr_v")
}
ABLATION = ("osr", "cql_both", "noisy_bc", "td3_bc")

TOO_SHORT = ("mopo", "rambo", "sdc", "osr_10", "sac_10", "edac_10", "rorl")
"""Methods that learn little in two minutes; a dagger marks them."""
COLUMNS = [name for name in TITLES if name in TABLES["table1"].methods]
KNOCKS = {
    "corrected": ("oos", ["torque-5", "torque-10", "torque-20"]),
    "released": ("official", [f"knock-official-{n}" for n in (5, 10, 15)]),
}
KNOCK_SIZES = ("slight", "moderate", "large")
"""Suites, and their disturbances of these sizes."""


def name_of(data: str) -> str:
    """Return a data set's name as the paper writes it."""
    robots = {
        "halfcheetah": "HalfCheetah",
        "antmaze": "AntMaze",
        "walker2d": "Walker2d",
    }
    first, _, rest = data.partition(" ")
    env, dash, size = first.partition("-")
    rest = rest if rest != "umaze" else ""
    return f"{robots.get(env, env.title())}{dash}{size} {rest}".strip()


def interval(found: Estimate) -> str:
    """Format an interval without decimals, on one line."""
    low, high = (f"{end:z.0f}".replace("-", "\N{MINUS SIGN}") for end in found[1:3])
    return f"[{low},\N{NO-BREAK SPACE}{high}]"


def small(*lines: str) -> str:
    """Return lines in small type."""
    text = "<br>".join(filter(None, lines))
    return f"<br><sub>{text}</sub>" if text else ""


def shown(found: Estimate | None, absent: str, seeds: str, *quoted: str) -> str:
    """Return a mean; small: its interval, number of seeds, and quoted numbers."""
    if found is None:
        return absent + small(*quoted)
    return decimal(found.mean) + small(interval(found) + seeds, *quoted)


def cell(runs: pd.DataFrame, *quoted: str) -> str:
    """Return the mean score of runs, or say that there are none.

    In a maze it is the share of successes, with the interval of a share.
    """
    seeds = SEEDS.format(runs["seed"].nunique())
    found = estimate(runs)
    if len(runs) and runs["data"].isin(MAZES).all():
        ends = wilson(int((runs["score"] > 0).sum()), len(runs))
        found = Estimate(found.mean, *(100 * end for end in ends))
    return shown(found, NOT_RUN, seeds, *quoted)


def number(value: float) -> str:
    """Format a quoted number in italics, or return nothing."""
    return "" if pd.isna(value) else f"<i>{decimal(value)}</i>"


def table1(clean: pd.DataFrame, printed: pd.DataFrame) -> str:
    """Return Table 1; ``clean`` has the undisturbed episodes."""
    parts = dict(iter(clean.groupby(["data", "method"])))
    rows, robots = [], [data for data in printed.index if "antmaze" not in data]
    for data in printed.index:
        found = {name: parts.get((data, name), clean.iloc[:0]) for name in COLUMNS}
        if not any(map(len, found.values())):
            continue
        own = clean.loc[clean["data"] == data, "data_score"].mean()
        quoted = [number(printed[method].get(data)) for method in COLUMNS]
        rows.append([name_of(data), decimal(own), *map(cell, found.values(), quoted)])
    both = clean[clean["data"].isin(robots)]
    means = both.groupby(["data", "method", "run"])["score"].mean()
    means = means.groupby(["data", "method"]).mean().groupby("method").mean()
    quoted = printed.loc[robots].mean(skipna=False)
    cells = [decimal(means[name]) + small(number(quoted[name])) for name in COLUMNS]
    own = decimal(both.groupby("data")["data_score"].mean().mean())
    rows.append([f"**Mean** of the robots' {len(robots)} rows", own, *cells])
    titles = (TITLES[name] + "\N{DAGGER}" * (name in TOO_SHORT) for name in COLUMNS)
    return markdown(["data", "data's mean", *titles], rows)


def table2(episodes: pd.DataFrame, printed: pd.DataFrame, protocol: str) -> str:
    """Return Table 2 under one of the protocols."""
    suite, names = KNOCKS[protocol]
    methods = [name for name in COLUMNS if name in TABLES["table2"].methods]
    played = episodes[episodes["suite"] == suite].set_index(["data", "method"])
    rows = []
    for env in ("halfcheetah", "walker2d", "hopper"):
        cells = [[f"{name_of(env)}, {knock}"] for knock in KNOCK_SIZES]
        for method in methods:
            mine = played[played.index == (f"{env} medium-expert", method)]
            met = mine["disturbed_at"].notna().groupby(mine["disturbance"]).mean()
            runs = [
                run.pivot_table("score", "episode", "disturbance")[["", *names]]
                for _, run in mine.groupby("run")
            ]
            found = scores_and_decreases(runs)[1:] if runs else [(None, None)] * 3
            for line, knock, name, pair in zip(
                cells, KNOCK_SIZES, names, found, strict=True
            ):
                share = f"met: {100 * met.get(name, 1):.0f} %"
                for kind, value in zip(("score", "decrease"), pair, strict=True):
                    absent = "\N{EN DASH}" if runs else NOT_RUN
                    quoted = number(printed.loc[(env, knock), f"{method} {kind}"])
                    note = share if kind == "score" and met.get(name, 1) < 1 else ""
                    seeds = SEEDS.format(len(runs))
                    line.append(shown(value, absent, seeds, note, quoted))
        rows += cells
    kinds = ("score", "loss %")
    head = [f"{TITLES[name]} {kind}" for name in methods for kind in kinds]
    return markdown(["robot, knock", *head], rows)


def figure4(clean: pd.DataFrame) -> str:
    """Draw Figure 4, and return its scores in a table."""
    shares = [0, 50, 70, 90]
    methods = [name for name in COLUMNS if name in TABLES["figure4"].methods]
    figure, grid = plt.subplots(1, len(ENVS), figsize=(11, 3.2), layout="constrained")
    rows = []
    for env, axes in zip(ENVS, grid, strict=True):
        axes.set_title(name_of(env), fontsize=10, loc="left")
        sets = [f"{env} expert", *(name for name in LIMITED if name.startswith(env))]
        for method in methods:
            mine = clean[clean["method"] == method]
            parts = [mine[mine["data"] == data] for data in sets]
            rows.append([name_of(env), TITLES[method], *map(cell, parts)])
            found = zip(shares, map(estimate, parts), strict=True)
            points = [(share, *score[:3]) for share, score in found if score]
            if points:
                share, mean, low, high = np.array(points).T
                axes.plot(share, mean, marker="o", label=TITLES[method])
                axes.fill_between(share, low, high, alpha=0.2)
    figure.supxlabel("random rows, %", fontsize=10)
    figure.supylabel("normalised score", fontsize=10)
    grid[0].legend(frameon=False, fontsize=8)
    figure.savefig(HERE / "figure4.png", dpi=110)
    plt.close(figure)
    return markdown(["robot", "method", *(f"{share} %" for share in shares)], rows)


def d4(clean: pd.DataFrame, quoted: pd.DataFrame) -> str:
    """Return appendix D.4: ten minutes, and small the two minutes of ``clean``."""
    grid = TABLES["d4"]
    place = RESULTS / grid.place
    longer = tables.read(place) if place.exists() else clean.iloc[:0]
    rows = []
    for data in grid.data:
        cells = []
        for method in grid.methods:
            ours, brief = (
                part[(part["data"] == data) & (part["method"] == method)]
                for part in (longer, clean)
            )
            published = quoted.get(data, {}).get(method, np.nan)
            two = f"two minutes: {decimal(brief['score'].mean())}"
            cells.append(cell(ours, two, number(published)))
        rows.append([name_of(data), *cells])
    return markdown(["data", *(TITLES[name] for name in grid.methods)], rows)


CLAIMS = [
    ("OSR scores higher than CQL", "osr", "cql", "score"),
    ("OSR scores higher than IQL", "osr", "iql", "score"),
    ("OSR scores higher than SDC", "osr", "sdc", "score"),
    ("OSR scores higher than MOPO", "osr", "mopo", "score"),
    ("OSR scores higher than RAMBO", "osr", "rambo", "score"),
    ("OSR-v scores higher than OSR", "osr_v", "osr", "score"),
    ("(ours) OSR scores higher than CQL + noisy BC", "osr", "cql_noisy_bc", "score"),
    ("Knocked, OSR scores higher than CQL", "osr", "cql", "knocked"),
    ("Knocked, OSR scores higher than SDC", "osr", "sdc", "knocked"),
    ("OSR loses fewer points to knocks than CQL", "cql", "osr", "lost"),
    ("OSR loses fewer points to knocks than SDC", "sdc", "osr", "lost"),
    ("OSR-v loses fewer points to knocks than CQL", "cql", "osr_v", "lost"),
]
"""A claim, whose number is larger than whose, and the kind of number."""


def claims(episodes: pd.DataFrame, printed: pd.DataFrame, knocked: pd.DataFrame) -> str:
    """Return the claims of Tables 1 and 2 beside our differences."""
    suite, names = KNOCKS["corrected"]
    played = episodes[episodes["suite"] == suite]
    pairs = played[played["disturbance"].isin(names)].merge(
        played.loc[played["disturbance"] == "", ["run", "episode", "score"]],
        on=["run", "episode"], suffixes=("", "_clean"),
    )  # fmt: skip
    pairs = pairs[pairs["data"].isin(EXPERTS)]
    after = knocked.filter(like="score").groupby("env").mean()
    after = after.rename(
        index=lambda env: f"{env} medium-expert", columns=lambda name: name.split()[0]
    )
    clean = episodes[episodes["suite"] == ""]
    sources = {
        "score": (clean[clean["data"].isin(printed.index)], printed),  # not Figure 4's
        "knocked": (pairs, after),
        "lost": (
            pairs.assign(score=pairs["score_clean"] - pairs["score"]),
            printed.reindex(after.index)[list(after)] - after,
        ),
    }
    rows = []
    for claim, more, less, kind in CLAIMS:
        part, theirs = sources[kind]
        part = part[part["method"].isin((more, less))]
        seeds = part.groupby(["data", "method"])["seed"].nunique().unstack()
        both = seeds.index[seeds.min(axis=1, skipna=False) >= 3]
        lead = (theirs[more] - theirs[less]).reindex(both).dropna()
        both = lead.index if len(lead) else both  # those that the paper prints
        found = differences(part[part["data"].isin(both)], more, less)
        ours = found[1] if found else None
        seen = "not resolved"
        if ours and not ours.low <= 0 <= ours.high:
            seen = "yes" if ours.low > 0 else "no, the reverse"
        note = "a low score has less to lose" if kind == "lost" else ""
        if short := [TITLES[name] for name in (more, less) if name in TOO_SHORT]:
            seen, note = "cannot judge", f"two minutes are too short for {short[0]}"
        cells = (number(lead.mean()), str(ours or NOT_RUN), str(len(both)), seen, note)
        rows.append([claim, *cells])
    head = ["claim", "paper", "here [95 %]", "data sets", "seen here", "note"]
    return markdown(head, rows)


def settings() -> str:
    """Return the pinned settings of the methods of Table 1, by kind of data."""
    path = ROOT / "tests" / "lab" / "run" / "settings.csv"
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    table["loss.recovery_weight"] += table["recovery.recovery_weight"]  # one is blank
    keys = ["loss.min_q_weight", "loss.num_random", "loss.recovery_weight"]
    keys += ["optim.actor_lr", "optim.qvalue_lr"]
    kinds = table.groupby(["method", "source"])[keys].agg(
        lambda values: " / ".join(dict.fromkeys(values))
    )
    rows = []
    for method in COLUMNS:
        pairs = zip(*(kinds.loc[(method, source)] for source in SOURCES), strict=True)
        rows.append([TITLES[method], *(" → ".join(dict.fromkeys(x)) for x in pairs)])
    return markdown(["method", *(f"`{key.partition('.')[2]}`" for key in keys)], rows)


def draw_curves(
    to: Path, methods: Iterable[str], place: Path = HERE, chosen: Sequence[int] = ()
) -> None:
    """Draw score over minutes of updates, every seed and the mean.

    ``chosen`` are runs of the tables in ``place``; default all.
    """
    runs = pd.read_csv(place / "runs.csv.xz")
    runs = runs[runs["run"].isin(chosen or runs["run"])]
    runs["method"] = runs["method"].str.partition("-")[0]  # of a trial's name
    sets = [data for data in SIX if data in set(runs["data"])]
    episodes = pd.read_csv(place / "episodes.csv.xz").merge(runs, on="run")
    episodes = episodes[episodes["suite"].isna()]
    minutes = TABLES["table1"].seconds / 60 * episodes["step"] / episodes["updates"]
    episodes = episodes.assign(minutes=minutes.round(3))
    colors = dict(zip(methods, COLORS, strict=False))
    down, across = -(-len(sets) // 3), min(3, len(sets))
    figure, grid = plt.subplots(
        down, across, figsize=(3.4 * across + 1.3, 3 * down),
        layout="constrained", sharex=True, squeeze=False,
    )  # fmt: skip
    for axes, data in zip(grid.flat, sets, strict=True):
        for method, color in colors.items():
            mine = episodes[(episodes["data"] == data) & (episodes["method"] == method)]
            by_seed = mine.groupby(["minutes", "seed"])["score"].mean().unstack()
            axes.plot(by_seed.index, by_seed, color=color, lw=0.5, alpha=0.4)
            axes.plot(by_seed.mean(axis=1), color=color, lw=2, label=TITLES[method])
        axes.set_title(name_of(data), fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
    lines = grid[0, 0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside right upper", frameon=False, fontsize=8)
    figure.supxlabel("minutes of updates on one core", fontsize=10)
    figure.supylabel("normalised score", fontsize=10)
    figure.savefig(to, dpi=110)
    plt.close(figure)


def methods_table(means: pd.DataFrame, titles: Mapping[str, str]) -> str:
    """Return the means of methods over the six data sets, best first."""
    rows = [
        [titles[name] + "\N{DAGGER}" * (name in TOO_SHORT), *map(decimal, line)]
        for name, line in means.iterrows()
        if name in titles
    ]
    return markdown(["method", "score", "disturbed", "recovery rate %"], rows)


def ablation() -> str:
    """Return the R of methods relative to OSR's twin, on the seeds that both have."""
    found = {(data, name): at for data, name, *at in tables.recovered(HERE)}
    rows = []
    for data in SIX:
        twin, walks = found[data, "cql_noisy_bc"]
        cells = []
        for name in ABLATION:
            ours, _ = found[data, name]
            seeds = twin.index.intersection(ours.index)
            cells.append(str(recovered_share(ours.loc[seeds], walks, twin.loc[seeds])))
        rows.append([name_of(data), *cells])
    return markdown(["R %", *(f"`{name}`" for name in ABLATION)], rows)


def tuning() -> str:
    """Return each method's best trial by its tuning seed, and its mean on others."""
    place = RESULTS / TABLES["tune"].place
    runs = tables.read(place)
    runs["trial"] = runs["method"]
    runs["method"] = runs["method"].str.partition("-")[0]
    rows, chosen = [], []
    for (data, method), mine in runs.groupby(["data", "method"]):
        trials = mine[mine["seed"] == 100].groupby("trial")["score"].mean()
        fresh = mine[(mine["trial"] == trials.idxmax()) & (mine["seed"] != 100)]
        chosen += fresh["run"].unique().tolist()
        best = " ".join(f"`{text}`" for text in TRIALS[trials.idxmax()][1:])
        cells = (str(len(trials)), best, decimal(trials.max()), cell(fresh))
        rows.append([name_of(data), TITLES[method], *cells])
    draw_curves(ROOT / "docs" / "figures" / "tuned.png", OWN, place, chosen)
    head = ["data", "method", "trials", "best", "tuning seed", "fresh seeds"]
    return markdown(head, rows)


def state() -> str:
    """Return how many runs of each table there are."""
    rows = []
    for name, table in TABLES.items():
        there = packed(RESULTS / table.place, table.suites)
        grid = [
            (data, method, seed, updates(method, table.seconds))
            for data in table.data
            for method in table.methods
            for seed in table.seeds
        ]
        rows.append([f"`{name}`", f"{len(grid)}", f"{len(there.intersection(grid))}"])
    return markdown(["table", "runs", "made"], rows)


def fill(path: Path, blocks: Mapping[str, str]) -> None:
    """Replace what is between a page's marks."""
    mark = re.compile(r"<!-- (\S+) -->.*?<!-- /\1 -->", re.S)

    def filled(found: re.Match[str]) -> str:
        name = found[1]
        block = f"\n\n{blocks[name]}\n\n" if "\n" in blocks[name] else blocks[name]
        return f"<!-- {name} -->{block}<!-- /{name} -->"

    text = path.read_text(encoding="utf-8")
    path.write_text(mark.sub(filled, text), encoding="utf-8")


def fill_readme(means: pd.DataFrame) -> None:
    """Put the means into the rows of the README's table of methods, best first."""
    path = ROOT / "README.md"
    text = path.read_text(encoding="utf-8")
    found = re.search(r"(\|`loss=`\|score\|disturbed\|\n\|[-|]+\n)((?:\|.*\n)+)", text)
    firsts = {re.search(r"`(\w+)`", row)[1]: row.split("|")[1]
              for row in found[2].splitlines()}  # fmt: skip
    rows = [
        f"|{firsts[name]}|{decimal(line['score'])}|{decimal(line['disturbed'])}|\n"
        for name, line in means.iterrows()
        if name in firsts
    ]
    rows += [f"|{firsts[name]}|||\n" for name in firsts if name not in means.index]
    path.write_text(text.replace(found[2], "".join(rows)), encoding="utf-8")


def main() -> None:
    """Fill the pages and draw the figures."""
    episodes = tables.read(HERE)
    clean = episodes[episodes["suite"] == ""]
    printed = pd.read_csv(HERE / "printed_table1.csv", index_col="data")
    quoted = pd.read_csv(HERE / "published.csv", index_col=0)
    for name in ("td3_bc", "rebrac", "cql_noisy_bc"):
        printed[name] = quoted.T.get(name, np.nan)
    knocked = pd.read_csv(HERE / "printed_table2.csv", index_col=["env", "knock"])

    six = episodes[episodes["data"].isin(SIX)]
    shown = six[six["suite"].isin(["", *TABLES["methods"].suites])]
    means = tables.means_over_data(shown, HERE)
    means["disturbed"] = means[list(TABLES["methods"].suites)].mean(axis=1)
    means = means[["undisturbed", "disturbed", "recoverable %"]]
    means.columns = ["score", "disturbed", "recovery"]
    blocks = {
        "claims": claims(episodes, printed, knocked),
        "table1": table1(clean, printed),
        "settings": settings(),
        "table2": table2(episodes, knocked, "corrected"),
        "table2-released": table2(episodes, knocked, "released"),
        "figure4": figure4(clean),
        "d4": d4(clean, quoted),
        "methods": methods_table(means, {name: f"`{name}`" for name in means.index}),
        "tuning": tuning(),
        "state": state(),
        "scores": methods_table(means, IN_DOCS),
    }
    # Single numbers in the text.
    for name, line in means.iterrows():
        blocks |= {f"{name}/{kind}": decimal(value) for kind, value in line.items()}
        for mark, sets in (("", SIX), ("/15", MUJOCO)):
            found = differences(clean[clean["data"].isin(sets)], "osr", name)
            blocks[f"osr-less-{name}{mark}"] = str(found and found[1])
    for (data, name), score in clean.groupby(["data", "method"])["score"]:
        blocks[f"{folder_name(data)}/{name}"] = decimal(score.mean())
    for (data, name), (_, share) in tables.recoverable(HERE).items():
        blocks[f"{folder_name(data)}/{name}/recovery"] = decimal(share)
    others, lead = quoted.loc["cql"].mean(), printed["osr"][SIX].mean()
    found = differences(clean[clean["data"].isin(SIX)], "cql", "osr_v")
    blocks["cql-less-osr_v"] = str(found and found[1])
    blocks["cql/printed"] = number(printed["cql"][SIX].mean())
    blocks["cql/published"] = number(others)
    blocks["osr-less-cql/published"] = number(lead - others)
    readmes = (place / "README.md" for place in (HERE, RESULTS / "mazes"))
    for page in (*readmes, ROOT / "docs" / "results.md"):
        fill(page, blocks)
    fill_readme(means)
    shown = ("osr", "cql", "cql_noisy_bc", "td3_bc", "iql")
    draw_curves(HERE / "curves.png", shown)
    draw_curves(RESULTS / "osr_v" / "scores.png", ("osr", "cql", "osr_v"))
    text = "\n".join(tables.main(HERE, "osr", SOURCES))
    blocks = {"tables": text, "ablation": ablation()}
    fill(HERE / "tables.md", blocks)


if __name__ == "__main__":
    main()
