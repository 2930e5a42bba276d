"""Compare any number of finished runs: verdict, tables and figures.

    torchrl-osr report outputs/oos
    torchrl-osr report multirun outputs --reference cql --output page

The page is <output>/report.html. The folder also gets a CSV file for each table and
the learning curves as PNG. docs/robustness.md explains the page.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from torchrl_osr.lab.report import comparison_notes, read_runs, write_report


def main() -> None:
    """Read the runs and write the report."""
    parser = argparse.ArgumentParser(prog=sys.argv[0], description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("runs", nargs="+", type=Path, help="folders of runs, or above them")
    add("--output", type=Path, default=Path("report"), help="a folder")
    add("--reference", help="method to compare with; default: the first one")
    options = parser.parse_args()
    command = " ".join([sys.argv[0], shlex.join(sys.argv[1:])])
    tables = read_runs(options.runs)
    for path, reason in tables.left_out:
        print(f"left out: {path}: {reason}")
    for note in comparison_notes(tables):
        print(f"note: {note}")
    page = write_report(
        tables, options.output, reference=options.reference, command=command
    )
    number = len(tables.runs)
    print(f"{number} run{'s' * (number > 1)} in {page}")
