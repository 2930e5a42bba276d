"""Print the tables of README.md from the raw results beside it.

    python results/oos/tables.py

Bold: the interval, over seeds, leaves out 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_osr.report.checks import cells, data_of, methods_of
from torchrl_osr.report.page import collect
from torchrl_osr.report.paired import ALL_DATA, Comparison, compare
from torchrl_osr.report.quantities import Quantity, quantities
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import decimal, recent_score

REFERENCE = "cql_noisy_bc"
OWN = ("osr", "osr_v")
ABLATIONS = ("cql", "cql_bc", REFERENCE, "osr_shuffled")
WIDE = ("osr_beta_1e-1", "osr_beta_1e-1_clean_model")
WIDE_REFERENCE = "cql_noisy_bc_beta_1e-1"


def differences(
    runs: Sequence[Run], method: str, reference: str, wanted: Sequence[Quantity]
) -> list[dict[str, str]]:
    """Return method less reference in each quantity, by data set."""
    return [
        {each.data: cell(each) for each in compare(runs, method, reference, quantity)}
        for quantity in wanted
    ]


def cell(each: Comparison) -> str:
    """Return a difference; bold if its interval over seeds leaves out 0."""
    if each.difference is None:
        return ""
    text = f"{decimal(each.difference.mean, '+')} {each.difference.interval}"
    told = each.verdict != "not told apart" and each.difference.over == "seeds"
    return f"**{text}**" if told else text


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print Markdown."""
    lines = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    print(f"\n{title}\n", *lines, sep="\n")


def tables_of_data(runs: Sequence[Run], wanted: Sequence[Quantity]) -> None:
    """Print a table for each data set: every method, and less the reference."""
    groups = cells(runs)
    found = {m: differences(runs, m, REFERENCE, wanted) for m in methods_of(runs)}
    found[REFERENCE] = [dict.fromkeys(data_of(runs), "0") for _ in wanted]
    head = ["", "seeds", "mean of the last five", *(each.name for each in wanted)]
    for data in data_of(runs):
        rows = [
            [
                f"`{method}`",
                ", ".join(str(run.seed) for run in group),
                str(recent_score(group)),
                *(column[data] for column in found[method]),
            ]
            for (of, method), group in groups.items()
            if of == data
        ]
        table(data, head, rows)


def table_over_all(runs: Sequence[Run], scores: Sequence[Quantity]) -> None:
    """Print both of our losses less each ablation, over all data sets."""
    rows = [
        [
            f"`{ablation}`",
            *(
                column[ALL_DATA]
                for method in OWN
                for column in differences(runs, method, ablation, scores)
            ),
        ]
        for ablation in ABLATIONS
    ]
    head = [f"`{method}`, {q.name}" for method in OWN for q in scores]
    table(ALL_DATA, ["less", *head], rows)


def tables_of_wide_noise(runs: Sequence[Run], wanted: Sequence[Quantity]) -> None:
    """Print wide noise less cloning with the same, for each data set that has it."""
    wide = {m: differences(runs, m, WIDE_REFERENCE, wanted) for m in WIDE}
    for data in data_of(runs):
        rows = [
            [f"`{method}`", *(column[data] for column in columns)]
            for method, columns in wide.items()
            if data in columns[0]
        ]
        if rows:
            head = ["", *(each.name for each in wanted)]
            table(f"{data}, less `{WIDE_REFERENCE}`", head, rows)


def main() -> None:
    """Print the tables of the grid, and that of the seeds beyond it."""
    here = Path(__file__).parent
    runs, _ = collect([here / "runs"])
    wanted = quantities(runs)
    tables_of_data(runs, wanted)
    table_over_all(runs, wanted[:2])
    tables_of_wide_noise(runs, wanted)
    print("\nSeeds beyond the grid")
    tables_of_data(collect([here / "more_seeds"])[0], wanted)


if __name__ == "__main__":
    main()
