"""Print the tables of README.md from the tables of runs beside it.

python results/oos/tables.py
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from torchrl_osr.report import RunTables, compare, quantities, read_runs
from torchrl_osr.report.scores import by_run, decimal, estimate, recent

HERE = Path(__file__).parent
REFERENCE = "cql_noisy_bc"
OWN = ("osr", "osr_v")
ABLATIONS = ("cql", "cql_bc", REFERENCE, "osr_shuffled")
WIDE = ("osr_beta_1e-1", "osr_beta_1e-1_clean_model")
WIDE_REFERENCE = "cql_noisy_bc_beta_1e-1"


def differences(
    tables: RunTables, methods: Sequence[str], reference: str
) -> pd.DataFrame:
    """Return each method less the reference, a column for each quantity.

    Returns:
        Texts by data set and method.
    """
    cells = {
        (each.data, method, quantity.name): f"{decimal(each.estimate.mean, '+')} "
        f"{each.estimate.interval()}"
        for quantity in quantities(tables)
        for method in methods
        if method != reference
        for each in compare(tables, method, reference, quantity)
        if each.estimate is not None
    }
    return pd.Series(cells).unstack(sort=False)


def show(title: str, frame: pd.DataFrame, corner: str = "") -> None:
    """Print a table as Markdown."""
    head = [corner, *frame.columns]
    rows = [[f"`{name}`", *cells] for name, *cells in frame.itertuples()]
    lines = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    print(f"\n{title}\n", *lines, sep="\n")


def by_data(tables: RunTables) -> None:
    """Print every method's scores, and those less the reference, by data set."""
    rows = {
        key: {
            "seeds": ", ".join(str(seed) for seed in group["seed"].unique()),
            "mean of the last five": str(estimate(by_run(group))),
        }
        for key, group in recent(tables.episodes).groupby(
            ["data", "method"], sort=False
        )
    }
    scores = pd.DataFrame.from_dict(rows, orient="index")
    frame = scores.join(differences(tables, tables.methods, REFERENCE)).fillna("0")
    for data in tables.data:
        show(data, frame.loc[data])


def main() -> None:
    """Print the tables of the grid, and those of the seeds beyond it."""
    tables = read_runs([HERE / "runs.jsonl.gz"])
    by_data(tables)
    less = {
        each: differences(tables, OWN, each).loc["all data sets"] for each in ABLATIONS
    }
    frame = pd.concat(less).unstack(sort=False).swaplevel(axis=1)
    frame = frame[
        [(own, name) for own in OWN for name in less["cql"] if "lost" not in name]
    ]
    frame.columns = [f"`{own}`, {name}" for own, name in frame.columns]
    show("All data sets", frame, "less")
    wide = differences(tables, WIDE, WIDE_REFERENCE)
    show(f"Hopper medium-replay, less `{WIDE_REFERENCE}`", wide.droplevel(0))
    print("\nSeeds beyond the grid")
    by_data(read_runs([HERE / "more_seeds.jsonl.gz"]))


if __name__ == "__main__":
    main()
