"""The example of docs/no_simulator.md, as it is read; its last part without torch."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

from mktestdocs import grab_code_blocks

PAGE = Path(__file__).parents[3] / "docs" / "no_simulator.md"


def test_the_page_leads_from_a_log_to_an_alarm(tmp_path, run):
    text = PAGE.read_text(encoding="utf-8")
    record, *use = grab_code_blocks(text, lang="python")
    (names,) = grab_code_blocks(text, lang="yaml")
    (tmp_path / "columns.yaml").write_text(names, encoding="utf-8")

    def python(*code: str) -> str:
        command = [sys.executable, "-c", "\n".join(code)]
        return subprocess.check_output(command, cwd=tmp_path, text=True)

    python(record)
    for command in grab_code_blocks(text, lang="bash"):
        run(tmp_path, *shlex.split(command)[1:])
    file = tmp_path / "arm" / "offline_evaluation.json"
    estimate = json.loads(file.read_text())["value"]
    output = python(*use, "import sys\nassert 'torch' not in sys.modules")
    assert "The first alarm is in step 100." in output
    measured, false = map(float, re.findall(r"return (-\d+), .* in (\d+)%", output)[0])
    assert abs(measured - estimate) < 40
    assert false <= 20
