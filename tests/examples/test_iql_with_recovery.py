"""The example that adds the recovery term to IQL, as a user runs it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "examples" / "iql_with_recovery.py"
ROW = re.compile(r"(.+?) +from the data's state (\d\.\d\d), pushed off it (\d\.\d\d)")


def test_recovery_brings_the_pushed_policy_closer_to_the_data():
    process = subprocess.run(
        [sys.executable, "-W", "error", str(SCRIPT), "60"],
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert process.returncode == 0, process.stderr
    title, *lines = process.stdout.strip().splitlines()[-3:]
    assert title.endswith("mean of seeds (0, 1, 2)")
    rows = [ROW.fullmatch(line).groups() for line in lines]
    assert [name for name, *_ in rows] == ["IQL alone", "IQL with recovery"]
    (unpushed, pushed), (_, recovered) = ([float(x) for x in row[1:]] for row in rows)
    assert 0 < unpushed < recovered < pushed < 2
