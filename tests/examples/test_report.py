"""The report's command line."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FAKES = ROOT / "tests" / "report" / "fakes.py"


def run(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    # A process of its own, as a user runs it.
    return subprocess.run(
        [sys.executable, str(ROOT / "examples" / "report.py"), *options],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_report_of_several_folders(tmp_path):
    write_run = runpy.run_path(str(FAKES))["write_run"]
    curve = {1000: [1.0, 2.0], 2000: [3.0, 4.0]}
    write_run(tmp_path / "a" / "0", curve, overrides=["loss=cql"])
    write_run(tmp_path / "b" / "0", curve, overrides=["loss=osr"])
    write_run(tmp_path / "b" / "1", curve, overrides=["loss=osr"], status="running")
    done = run(tmp_path, "a", "b", "--reference", "osr", "--output", "new/report")
    assert done.returncode == 0, done.stderr
    assert "left out: b/1: not finished, its status is running\n" in done.stdout
    assert "mind: No run has its versions recorded.\n" in done.stdout
    assert done.stdout.endswith("2 runs in new/report/report.html\n")
    page = (tmp_path / "new" / "report" / "report.html").read_text(encoding="utf-8")
    assert "cql is worse than" not in page
    assert "undisturbed score: cql is not told apart from osr" in page
    assert "a b --reference osr --output new/report" in page


def test_what_cannot_be_reported_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report.py", "nowhere"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "examples" / "report.py"), run_name="__main__")
    assert stopped.value.code == 1
    assert capsys.readouterr().err == "nowhere is no folder.\n"
