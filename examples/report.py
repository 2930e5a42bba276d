"""Write one page about any number of finished runs: verdict, tables, figures.

    python examples/report.py outputs/oos
    python examples/report.py multirun/*/ outputs/ --reference cql --output report
    python examples/report.py results/oos/runs.jsonl.gz

Looks in and below the folders for what ``examples/offline_osr.py`` and
``examples/evaluate.py`` left there; a table of runs is read as it is. ``report.html``
needs no other file; the figures are beside it as PNG files, too. How to read it:
docs/report.md.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from torchrl_osr.report import comparison_notes, read_runs, write_report


def main() -> None:
    """Read, report, and say what could not be."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "runs", nargs="+", type=Path, help="folders of runs, or above them, or tables"
    )
    parser.add_argument("--output", type=Path, default=Path("report"), help="a folder")
    parser.add_argument("--reference", help="method to compare with; default the first")
    options = parser.parse_args()

    command = shlex.join(["python", *sys.argv])
    try:
        tables = read_runs(options.runs)
        for path, reason in tables.left_out:
            print(f"left out: {path}: {reason}")
        for note in comparison_notes(tables):
            print(f"mind: {note}")
        page = write_report(
            tables, options.output, reference=options.reference, command=command
        )
    except (OSError, ValueError) as error:
        parser.exit(1, f"{error}\n")
    print(f"{len(tables.runs)} runs in {page}")


if __name__ == "__main__":
    main()
