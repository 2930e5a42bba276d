"""Write one page about any number of finished runs: verdict, tables, figures.

    torchrl-osr report outputs/oos
    torchrl-osr report multirun/*/ outputs/ --reference cql --output report
    torchrl-osr report outputs/oos --pack runs.jsonl.gz
    torchrl-osr report runs.jsonl.gz

Looks in and below the folders for what ``torchrl-osr train`` and
``torchrl-osr evaluate`` left there. ``report.html`` needs no other file; the figures
are beside it as PNG files, too. ``--pack`` writes no page, but all that a page is made
of into one table of runs. How to read the page: docs/report.md.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from torchrl_osr.lab.report import comparison_notes, pack_runs, read_runs, write_report

EXAMPLES = """\
  torchrl-osr report outputs
  torchrl-osr report multirun outputs --reference cql --output page
  torchrl-osr report outputs --pack runs.jsonl.gz && torchrl-osr report runs.jsonl.gz

The page is <output>/report.html; docs/report.md says how to read it.
"""


def main() -> None:
    """Read, report, and say what could not be."""
    parser = argparse.ArgumentParser(
        prog=sys.argv[0],
        description=__doc__.split("\n")[0],
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs",
        nargs="+",
        type=Path,
        help="folders of runs, or above them, or tables of --pack",
    )
    parser.add_argument("--output", type=Path, default=Path("report"), help="a folder")
    parser.add_argument("--reference", help="method to compare with; default the first")
    parser.add_argument("--pack", type=Path, metavar="TABLE", help="a .jsonl.gz file")
    options = parser.parse_args()

    command = " ".join([sys.argv[0], shlex.join(sys.argv[1:])])
    if options.pack:
        if not options.pack.name.endswith(".jsonl.gz"):
            parser.error(f"--pack {options.pack}: a table's name ends in .jsonl.gz.")
        if files := [str(each) for each in options.runs if each.is_file()]:
            parser.error(f"--pack takes folders of runs, got {', '.join(files)}.")
        number = pack_runs(options.runs, options.pack)
        print(f"{number} runs in {options.pack}")
        return
    tables = read_runs(options.runs)
    for path, reason in tables.left_out:
        print(f"left out: {path}: {reason}")
    for note in comparison_notes(tables):
        print(f"note: {note}")
    page = write_report(
        tables, options.output, reference=options.reference, command=command
    )
    print(f"{len(tables.runs)} runs in {page}")


if __name__ == "__main__":
    main()
