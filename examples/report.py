"""Write one page about any number of finished runs: tables, figures, differences.

    python examples/report.py outputs/oos
    python examples/report.py multirun/*/ outputs/ --reference cql --output report

Looks in and below the folders for what ``examples/offline_osr.py`` and
``examples/evaluate.py`` left there. ``report.html`` needs no other file; the figures
lie beside it as PNG files, too. How to read it: docs/report.md.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from torchrl_osr.report.checks import comparison_notes
from torchrl_osr.report.page import choose_reference, collect, write_report


def main() -> None:
    """Read, report, and say what could not be."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, help="of runs, or above them")
    parser.add_argument("--output", type=Path, default=Path("report"), help="a folder")
    parser.add_argument("--reference", help="method to compare with; default the first")
    options = parser.parse_args()

    try:
        runs, left_out = collect(options.folders)
        reference = choose_reference(runs, options.reference)
    except (FileNotFoundError, ValueError) as error:
        parser.exit(1, f"{error}\n")

    for each in left_out:
        print(f"left out: {each.path}: {each.reason}")
    for note in comparison_notes(runs):
        print(f"mind: {note}")
    command = shlex.join(["python", *sys.argv])
    page = write_report(
        runs, left_out, options.output, reference=reference, command=command
    )
    print(f"{len(runs)} runs in {page}")


if __name__ == "__main__":
    main()
