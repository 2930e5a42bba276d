"""The example of docs/your_data.md, as it is read: its files saved, its lines typed."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from mktestdocs import check_md_file, grab_code_blocks

PAGE = Path(__file__).parents[3] / "docs" / "your_data.md"


def test_the_page_leads_from_a_log_to_a_policy(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    check_md_file(PAGE, memory=True)
    assert (tmp_path / "pendulum.csv").exists()
    text = PAGE.read_text(encoding="utf-8")
    (names,) = grab_code_blocks(text, lang="yaml")
    (tmp_path / "columns.yaml").write_text(names, encoding="utf-8")

    def typed(command: str) -> str:
        blocks = grab_code_blocks(text, lang="bash")
        line = next(each for each in blocks if each.startswith(command))
        return run(tmp_path, *shlex.split(line)[1:])

    shown = grab_code_blocks(text, lang="text")[0].strip().splitlines()
    assert typed("torchrl-osr data").strip().splitlines() == shown

    typed("torchrl-osr train env.id")
    folder = tmp_path / "pendulum"
    returns = json.loads((folder / "returns.json").read_text())
    assert returns["last"]["step"] == 40
    assert all(-2000 < each < 0 for each in returns["last"]["returns"])
    assert (folder / "curve.png").exists()
    typed("torchrl-osr export")
    assert (tmp_path / "pendulum.safetensors").exists()
