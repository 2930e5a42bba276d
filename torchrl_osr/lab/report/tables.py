"""Tables of scores, robustness and recoverable states.

A cell is an :class:`~torchrl_osr.lab.evaluation.statistics.Estimate`, text or number.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from torchrl_osr.lab.evaluation.recoverable import GROUPS, disturbances_of
from torchrl_osr.lab.evaluation.recovery import STEPS_AFTER
from torchrl_osr.lab.evaluation.statistics import (
    Array,
    decimal,
    estimate,
    nested_mean,
    never_certain,
    recovered_share,
    scores_and_decreases,
)
from torchrl_osr.lab.evaluation.tables import NUM_RECENT
from torchrl_osr.lab.report.runs import SAVED, RunTables


def recent(episodes: pd.DataFrame, number: int = NUM_RECENT) -> pd.DataFrame:
    """Select the undisturbed episodes of the last evaluations, without step 0."""
    found = episodes[(episodes["suite"] == "") & (episodes["step"] > 0)]
    return found[found.groupby("run")["step"].rank("dense", ascending=False) <= number]


def by_run(episodes: pd.DataFrame) -> list[Array]:
    """Return the scores of each run's start states, ``[E]`` each.

    Evaluations that start in the same state are averaged: they are no new episodes.
    """
    means = episodes.groupby(["run", "episode"], sort=False)["score"].mean()
    return [run.to_numpy() for _, run in means.groupby("run", sort=False)]


def score_table(tables: RunTables) -> pd.DataFrame:
    """Tabulate undisturbed scores, by data set and method."""
    rows = {}
    for key, group in tables.episodes.groupby(["data", "method"], sort=False):
        of = tables.runs.loc[group["run"].unique()]
        rows[key] = {
            "seeds": f"{len(of)} ({', '.join(map(str, sorted(of['seed'])))})",
            "updates": f"{of['steps'].iloc[0]:,}",
            "last": estimate(by_run(recent(group, 1))),
            f"mean of the last {NUM_RECENT}": estimate(by_run(recent(group))),
            "data mean": of["data_score"].iloc[0],
        }
    return frame_of(rows, "data", "method")


def robustness_table(episodes: pd.DataFrame) -> pd.DataFrame:
    """Tabulate scores and recovery under a suite, by data, disturbance and method.

    Scores are over all episodes. The columns after ``met`` are over the episodes that
    met the disturbance.
    """
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for (data, method), group in episodes.groupby(["data", "method"], sort=False):
        names = list(group["disturbance"].unique())
        runs = [
            run.pivot_table("score", "episode", "disturbance")[names]
            for _, run in group.groupby("run", sort=False)
        ]
        scores = scores_and_decreases(runs)
        clean = scores[names.index("")][0]
        for name, (score, lost) in zip(names, scores, strict=True):
            level = group[group["disturbance"] == name]
            there = level[level["disturbed_at"].notna()]
            row = {
                "seeds": len(runs),
                "clean": clean,
                "disturbed": score,
                "lost %": lost if len(there) else None,
                "met %": 100 * len(there) / len(level),
            }
            if name:
                rows.setdefault((data, name), {})[method] = row | _recovery(there)
    flat = {(*key, name): row for key, of in rows.items() for name, row in of.items()}
    return frame_of(flat, "data", "disturbance", "method")


def _recovery(there: pd.DataFrame) -> dict[str, Any]:
    """Return the percentages of the episodes that met a disturbance that ends."""
    if not there["survived_knock"].notna().any():
        return {}
    columns = ["survived_knock", "alive_after", "clean_alive_after"]
    shares = there.groupby("run")[columns].mean().mean()  # runs have equal weight
    back = 100.0 * (there["recovery_steps"] <= STEPS_AFTER)
    runs = [run.to_numpy() for _, run in back.groupby(there["run"], sort=False)]
    recovered = never_certain(nested_mean([runs]), max(map(len, runs)))
    median = there["recovery_steps"].fillna(np.inf).median()
    return {
        "stood %": 100 * shares["survived_knock"],
        f"stood +{STEPS_AFTER} %": 100 * shares["alive_after"],
        "(undisturbed) %": 100 * shares["clean_alive_after"],
        "recovered %": recovered,
        "median steps": median if np.isfinite(median) else "most never",
    }


def recovery_table(saved: pd.DataFrame, reference: str = "") -> pd.DataFrame:
    """Tabulate recovery rates by group of states and, if recoverable, by disturbance.

    R compares with the reference, with the seeds of both.
    """
    cells = {}
    for (data, states), rows in saved.groupby(["data", "states"], sort=False):
        rows = rows.assign(state=rows.groupby("run").cumcount())
        of_each = rows.drop_duplicates("state")  # they have the same order in each run
        group, disturbance, walk = (of_each[name].to_numpy() for name in SAVED[1:-1])
        keys = ["run", "method", "seed"]  # sorted by run: resamples draw in this order
        back = rows.pivot(index=keys, columns="state", values="back").droplevel("run")
        hard = group == GROUPS[-1]
        chosen = {f"{name} %": group == name for name in GROUPS if name in group}
        chosen |= {
            f"{name} %": hard & (disturbance == name)
            for name in disturbances_of(disturbance[hard])
        }
        methods = rows["method"].unique()
        for method in methods:
            table = back.loc[method].astype(float)
            row: dict[str, Any] = {"seeds": len(table)}
            if reference in methods and method != reference and hard.any():
                theirs = back.loc[reference].astype(float)
                both = table.index.intersection(theirs.index)
                ours, theirs = (each.loc[both, hard] for each in (table, theirs))
                row["R %"] = None
                if len(both):
                    with contextlib.suppress(ValueError):  # the reference saves all
                        row["R %"] = recovered_share(ours, walk[hard], theirs)
            for name, which in chosen.items():
                row[name] = recovered_share(table.loc[:, which], walk[which])
            cells[f"{data}, {states}", method] = row
    return frame_of(cells, "data", "method")


def text(cell: Any) -> str:
    """Format a cell; nothing is a dash."""
    if cell is None or (isinstance(cell, float) and np.isnan(cell)):
        return "-"
    return decimal(cell) if isinstance(cell, float) else str(cell)


def frame_of(rows: Mapping[Any, Mapping[str, Any]], *names: str) -> pd.DataFrame:
    """Return a table with a row for each key, whose parts have names."""
    frame = pd.DataFrame(list(rows.values()), dtype=object)
    return frame.set_index(pd.MultiIndex.from_tuples(rows, names=names))
