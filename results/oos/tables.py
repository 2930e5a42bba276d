"""Print the tables of README.md from the raw results beside it.

python results/oos/tables.py
"""

from __future__ import annotations

from pathlib import Path

from torchrl_osr.report.checks import cells, data_of, methods_of
from torchrl_osr.report.page import collect
from torchrl_osr.report.paired import ALL_DATA, Comparison, compare
from torchrl_osr.report.quantities import quantities
from torchrl_osr.report.runs import Run
from torchrl_osr.report.scores import recent_score

REFERENCE = "cql_noisy_bc"


def cell(found: list[Comparison], data: str) -> str:
    """Return a difference; bold if its interval over seeds leaves out 0."""
    for each in found:
        if each.data == data and each.difference is not None:
            mean, low, high, over = each.difference
            text = f"{mean:+.1f} [{low:.1f}, {high:.1f}]"
            if over == "episodes":
                return f"{text} ᵉ"
            return text if low <= 0 <= high else f"**{text}**"
    return ""


def rows(runs: list[Run], data: str) -> list[str]:
    """Return a data set's lines."""
    groups, lines = cells(runs), []
    for method in methods_of(runs):
        group = groups.get((data, method), [])
        if not group and data != ALL_DATA:
            continue
        differences = [
            "0"
            if method == REFERENCE
            else cell(compare(runs, method, REFERENCE, q), data)
            for q in quantities(runs)
        ]
        score = f" {recent_score(group)} |" if group else ""
        lines.append(f"| `{method}` |{score} {' | '.join(differences)} |")
    return lines


def main() -> None:
    """Print a table for each data set, and one over all."""
    runs, _ = collect([Path(__file__).parent / "runs"])
    names = [each.name for each in quantities(runs)]
    data_sets = data_of(runs)
    for data in [*data_sets, *([ALL_DATA] if len(data_sets) > 1 else [])]:
        score = [] if data == ALL_DATA else ["mean of the last five"]
        head = ["", *score, *(f"{name}, less `{REFERENCE}`" for name in names)]
        print(f"\n### {data}\n\n| {' | '.join(head)} |\n{'|---' * len(head)}|")
        print("\n".join(rows(runs, data)))


if __name__ == "__main__":
    main()
