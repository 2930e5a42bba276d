"""Print the tables of README.md from the raw results beside it.

python results/oos/tables.py
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_osr.report.checks import cells, data_of
from torchrl_osr.report.page import collect
from torchrl_osr.report.paired import ALL_DATA, compare
from torchrl_osr.report.quantities import Quantity, quantities
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import decimal, recent_score

REFERENCE = "cql_noisy_bc"
OWN = ("osr", "osr_v")
ABLATIONS = ("cql", "cql_bc", REFERENCE, "osr_shuffled")
WIDE = ("osr_beta_1e-1", "osr_beta_1e-1_clean_model")
WIDE_REFERENCE = "cql_noisy_bc_beta_1e-1"


def difference(
    runs: Sequence[Run], data: str, method: str, reference: str, quantity: Quantity
) -> str:
    """Return method less reference; bold if the interval over seeds leaves out 0."""
    if method == reference:
        return "0"
    for each in compare(runs, method, reference, quantity):
        if each.data == data and each.difference is not None:
            mean, low, high, over = each.difference
            text = f"{decimal(mean, '+')} [{decimal(low)}, {decimal(high)}]"
            if over == "episodes":
                return f"{text} ᵉ"
            return text if low <= 0 <= high else f"**{text}**"
    return ""


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print Markdown."""
    lines = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    print(f"\n{title}\n", *lines, sep="\n")


def main() -> None:
    """Print a table for each data set, one over all, and one of the wide noise."""
    runs, _ = collect([Path(__file__).parent / "runs"])
    groups, wanted = cells(runs), quantities(runs)
    names = [each.name for each in wanted]
    for data in data_of(runs):
        rows = [
            [
                f"`{method}`",
                str(len(group)),
                str(recent_score(group)),
                *(difference(runs, data, method, REFERENCE, q) for q in wanted),
            ]
            for (of, method), group in groups.items()
            if of == data
        ]
        table(data, ["", "seeds", "mean of the last five", *names], rows)
    score, disturbed, _ = wanted
    rows = [
        [
            f"`{ablation}`",
            *(
                difference(runs, ALL_DATA, method, ablation, quantity)
                for method in OWN
                for quantity in (score, disturbed)
            ),
        ]
        for ablation in ABLATIONS
    ]
    head = [f"`{method}`, {q.name}" for method in OWN for q in (score, disturbed)]
    table(ALL_DATA, ["less", *head], rows)
    for data in data_of(runs):
        rows = [
            [
                f"`{method}`",
                *(difference(runs, data, method, WIDE_REFERENCE, q) for q in wanted),
            ]
            for method in WIDE
            if (data, method) in groups
        ]
        if rows:
            table(f"{data}, less `{WIDE_REFERENCE}`", ["", *names], rows)


if __name__ == "__main__":
    main()
