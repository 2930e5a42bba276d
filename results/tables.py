"""Print the tables of an experiment in Markdown.

    python results/tables.py results/paper --data medium-replay medium-expert
    python results/tables.py results/oos --reference cql_noisy_bc

Reads ``runs.csv.xz``, ``episodes.csv.xz`` and, where they exist, ``recoverable.csv.xz``
with ``states.csv.xz`` and ``published.csv``. Intervals at 95 % resample seeds, then
those of differences episodes, those of recoverable states walks. A mark ² means two
seeds, ᵉ one seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from torchrl_osr.lab.evaluation import statistics
from torchrl_osr.lab.evaluation.statistics import Estimate, recovered_share
from torchrl_osr.lab.report.tables import by_run


def read(folder: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Return a row for each episode, with its run's data set, method and seed.

    ``sources`` are kinds of data, such as ``"medium-expert"``; default all.
    """
    runs = pd.read_csv(folder / "runs.csv.xz")
    if sources:
        runs = runs[runs["data"].str.partition(" ")[2].isin(sources)]
    episodes = pd.read_csv(folder / "episodes.csv.xz").merge(runs, on="run")
    for column in ("suite", "disturbance"):  # "" is undisturbed
        episodes[column] = episodes[column].fillna("") if column in episodes else ""
    trained = episodes["suite"] == ""
    order = episodes[trained].groupby("run")["step"].rank("dense", ascending=False)
    # The training's own evaluations: the last five count.
    return episodes[~trained | (order.reindex(episodes.index) <= 5)]


def conditions(episodes: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the undisturbed episodes, then the disturbed ones of each suite."""
    yield "undisturbed", episodes[episodes["suite"] == ""]
    for suite in sorted(set(episodes["suite"]) - {""}):
        rows = episodes["suite"] == suite
        yield suite, episodes[rows & (episodes["disturbance"] != "")]


def estimate(episodes: pd.DataFrame) -> Estimate | None:
    """Return the mean score over runs; episodes of one start state are averaged."""
    return None if episodes.empty else statistics.estimate(by_run(episodes))


def differences(
    episodes: pd.DataFrame, method: str, reference: str
) -> tuple[int, Estimate] | None:
    """Return the fewest seeds, and the mean difference over all data sets.

    Runs are paired by data set and seed, episodes by checkpoint and start state.
    """
    keys = ["data", "seed", "disturbance", "checkpoint", "episode"]
    rank = episodes.groupby("run")["step"].rank("dense")  # budgets differ
    values = episodes.assign(checkpoint=rank)
    values = values[values["method"].isin((method, reference))]
    table = values.pivot_table(index=keys, columns="method", values="score").dropna()
    if set(table.columns) != {method, reference}:
        return None
    less = table[method] - table[reference]
    less = less.groupby(["data", "seed", "episode"]).mean()
    if set(less.index.unique("data")) != set(episodes["data"]):
        return None
    data_sets = [
        [run.to_numpy() for _, run in group.groupby("seed")]
        for _, group in less.groupby("data")
    ]
    return min(map(len, data_sets)), statistics.nested_mean(data_sets)


def recovered(folder: Path) -> Iterator[tuple[str, str, pd.DataFrame, np.ndarray]]:
    """Yield data set, method, rates of seeds and states, and the states' walks.

    The held-out half of the recoverable states comes first.
    """
    if not (folder / "recoverable.csv.xz").exists():
        return
    runs = pd.read_csv(folder / "runs.csv.xz")
    back = pd.read_csv(folder / "recoverable.csv.xz", dtype={"back": str})
    states = pd.read_csv(folder / "states.csv.xz").groupby("states")
    keys = ["data", "method", "half", "states"]
    for (data, method, _, mark), rows in back.merge(runs, on="run").groupby(keys):
        of_each = states.get_group(mark)
        hard = (of_each["group"] == "recoverable").to_numpy()
        table = np.array([[int(digit) for digit in text] for text in rows["back"]])
        table = table[:, hard] / rows["checkpoints"].to_numpy()[:, None]
        rates = pd.DataFrame(table, index=rows["seed"])
        yield data, method, rates, of_each["walk"].to_numpy()[hard]


def recoverable(folder: Path) -> dict[tuple[str, str], tuple[str, float]]:
    """Return the recovery rate in percent of each data set and method."""
    found = {}
    for data, method, rates, walks in recovered(folder):
        share = recovered_share(rates, walks)
        # The held-out half wins over the public one.
        found.setdefault((data, method), (str(share), share.mean))
    return found


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def means_over_data(episodes: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """Return the means of the methods that have runs on every data set, best first."""
    means = pd.DataFrame(
        {
            name: part.groupby(["method", "data", "run"])["score"].mean()
            for name, part in conditions(episodes)
        }
    )
    means = means.groupby(["method", "data"]).mean()
    complete = means.groupby("method").size() == episodes["data"].nunique()
    if saved := recoverable(folder):
        share = {(method, data): each[1] for (data, method), each in saved.items()}
        means["recoverable %"] = pd.Series(share)
    means = means.groupby("method").mean()[complete]
    return means.sort_values("undisturbed", ascending=False)


def main(folder: Path, reference: str, sources: Sequence[str] = ()) -> Iterator[str]:
    """Yield a table for each data set, means over all, and differences."""
    episodes, saved = read(folder, sources), recoverable(folder)
    there = episodes.groupby("suite")["data"].nunique()
    everywhere = there.index[there == episodes["data"].nunique()]
    episodes = episodes[episodes["suite"].isin(everywhere)]
    suites = [name for name, _ in conditions(episodes)]
    quoted = folder / "published.csv"
    published = pd.read_csv(quoted, index_col=0) if quoted.exists() else pd.DataFrame()

    head = ["method", "seeds", "updates", *suites]
    head += ["recoverable %"] * bool(saved) + ["published"] * (not published.empty)
    for data, mine in episodes.groupby("data"):
        rows = []
        for method, of in mine.groupby("method"):
            cells = [str(of["seed"].nunique()), f"{of['updates'].max():,}"]
            cells += [str(estimate(part) or "") for _, part in conditions(of)]
            cells += [saved.get((data, method), ("", 0))[0]] if saved else []
            if not published.empty:
                cells.append(str(published.get(data, {}).get(method, "")))
            mean = of[of["suite"] == ""].groupby("run")["score"].mean().mean()
            rows.append((mean, [f"`{method}`", *cells]))
        rows.sort(key=lambda row: -row[0])
        yield f"## {data}\n\n{markdown(head, [cells for _, cells in rows])}\n"

    if episodes["data"].nunique() == 1:
        return
    means = means_over_data(episodes, folder)
    rows = [[f"`{each[0]}`", *(f"{x:.1f}" for x in each[1:])]
            for each in means.itertuples()]  # fmt: skip
    yield f"## Means over all data sets\n\n{markdown(['method', *means], rows)}\n"

    rows = []
    for method in sorted(set(episodes["method"]) - {reference}):
        found = [
            differences(part, reference, method) for _, part in conditions(episodes)
        ]
        if all(found):
            cells = [str(each[1]) for each in found if each]
            rows.append([f"`{method}`", str(found[0][0] if found[0] else ""), *cells])
    yield f"## `{reference}` less each other method, over all data sets\n"
    yield markdown(["less", "seeds", *suites], rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--reference", default="osr")
    parser.add_argument("--data", nargs="+", default=(), metavar="SOURCE")
    given = parser.parse_args()
    print(*main(given.folder, given.reference, given.data), sep="\n")
