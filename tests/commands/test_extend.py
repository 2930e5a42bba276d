"""docs/extend.md as it is read: its files saved, its lines typed, in a new folder."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from mktestdocs import grab_code_blocks

PAGE = (Path(__file__).parents[2] / "docs" / "extend.md").read_text(encoding="utf-8")


def save_files(folder: Path) -> None:
    """Write each block whose text before it names a file."""
    blocks = re.findall(
        r"`([\w/.]+\.(?:py|yaml))`[^`]*:\n\n```\w+\n(.*?)```", PAGE, re.S
    )
    assert [name for name, _ in blocks] == ["my_losses.py", "conf/loss/awac.yaml"]
    for name, text in blocks:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def typed(command: str) -> list[str]:
    """Arguments of the page's line that begins with this command."""
    block = "\n".join(grab_code_blocks(PAGE, lang="bash"))
    (line,) = (line for line in block.splitlines() if line.startswith(command))
    return shlex.split(line)[1:]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run, tiny) -> Path:
    folder = tmp_path_factory.mktemp("plug_in")
    save_files(folder)
    code, output = run(folder, *typed("torchrl-osr train"), *tiny("medium"))
    assert code == 0, output
    assert "Warning" not in output
    return folder


def test_it_trains(folder):
    assert json.loads((folder / "runs/awac/status.json").read_text()) == {
        "status": "done"
    }
    scalars = folder / "runs" / "awac" / "csv" / "scalars" / "policy"
    assert {path.stem for path in scalars.glob("*")} >= {"loss_actor", "pred_value"}


def test_it_is_evaluated_exported_and_reported(folder, run):
    sizes = ["suite=start", "episodes=2", "last=1"]
    code, output = run(folder, *typed("torchrl-osr evaluate"), *sizes)
    assert code == 0, output
    assert (folder / "runs" / "awac" / "robustness-start.json").exists()
    code, output = run(folder, *typed("torchrl-osr export"))
    assert code == 0, output
    code, output = run(folder, *typed("torchrl-osr report"))
    assert code == 0, output
    assert "awac" in (folder / "report" / "report.html").read_text(encoding="utf-8")
