"""The example that adds the recovery term to IQL, as a user runs it."""

from __future__ import annotations

import re
import subprocess
import sys

from processes import EXAMPLES

ROW = re.compile(r"(.+?) +from the data's state (\d\.\d\d), pushed off it (\d\.\d\d)")


def test_recovery_brings_the_pushed_policy_closer_to_the_data():
    command = [sys.executable, "-W", "error", EXAMPLES / "iql_with_recovery.py", "60"]
    output = subprocess.check_output(command, text=True, timeout=240)
    title, *lines = output.strip().splitlines()[-3:]
    assert title.endswith("mean of seeds (0, 1, 2)")
    rows = [ROW.fullmatch(line).groups() for line in lines]
    assert [name for name, *_ in rows] == ["IQL alone", "IQL with recovery"]
    (unpushed, pushed), (_, recovered) = ([float(x) for x in row[1:]] for row in rows)
    assert 0 < unpushed < recovered < pushed < 2
