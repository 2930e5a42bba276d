"""docs/from_a_csv_to_a_policy.md is run as it stands."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from mktestdocs import check_md_file, grab_code_blocks

PAGE = Path(__file__).parents[3] / "docs" / "from_a_csv_to_a_policy.md"


def test_the_page_leads_from_a_log_to_a_policy(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    check_md_file(PAGE, memory=True)
    assert (tmp_path / "pendulum.csv").exists()
    text = PAGE.read_text(encoding="utf-8")
    look, train = (
        shlex.split(block.strip()) for block in grab_code_blocks(text, lang="bash")
    )
    assert look[:2] == ["torchrl-osr", "data"]
    code, output = run(tmp_path, *look[1:])
    assert code == 0, output
    (shown,) = grab_code_blocks(text, lang="text")
    # All but the last line, which has a folder.
    assert output.strip().splitlines()[:-1] == shown.strip().splitlines()[:-1]
    assert (tmp_path / "pendulum-data.png").exists()

    assert train[:2] == ["torchrl-osr", "train"]
    code, output = run(tmp_path, *train[1:])
    assert code == 0, output
    folder = tmp_path / "pendulum"
    returns = json.loads((folder / "returns.json").read_text())
    assert returns["last"]["step"] == 40
    assert all(-2000 < each < 0 for each in returns["last"]["returns"])
    assert (folder / "curve.png").exists()
    assert (folder / "checkpoint" / "policy" / "best.torchrl").exists()
