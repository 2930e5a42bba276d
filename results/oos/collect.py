"""Gather the raw results of the finished runs, and report on them.

    python results/oos/collect.py outputs/oos

Writes below this folder ``runs/<data>/<method>/seed<k>/`` and ``report/``. Seeds that
are not of the grid go to ``more_seeds/``, which the report leaves alone. Numbers of the
JSON files keep five digits.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
GRID = ("seed0", "seed1", "seed2")
REPORT = ("runs", "--reference", "cql_noisy_bc")
RAW = ("returns.json", "inverse_dynamics.json", "robustness-oos.json", "status.json")


def compact(text: str) -> str:
    """Return JSON on one line, with five digits a number."""
    value = json.loads(text, parse_float=lambda number: float(f"{float(number):.5g}"))
    return json.dumps(value, separators=(",", ":")) + "\n"


def gather(folder: Path, target: Path) -> None:
    """Copy the small files of one run."""
    target.mkdir(parents=True, exist_ok=True)
    shutil.copy(folder / "config.yaml", target)
    for name in RAW:
        if (folder / name).exists():
            (target / name).write_text(compact((folder / name).read_text()))


def main(folder: Path) -> None:
    """Gather and report."""
    for finished in sorted(folder.glob("*/*/seed*/robustness-oos.json")):
        run = finished.parent
        part = "runs" if run.name in GRID else "more_seeds"
        gather(run, HERE / part / run.relative_to(folder))
    # From here, so that the page names the runs as they lie in the repository.
    subprocess.run(
        [sys.executable, "../../examples/report.py", *REPORT],
        cwd=HERE,
        check=True,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
