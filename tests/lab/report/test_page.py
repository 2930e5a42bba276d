"""The page, its tables and its figures."""

from __future__ import annotations

import base64
import re

import pandas as pd
import pytest
from lab.report import fakes

from torchrl_osr.lab.report import read_runs, write_report

EVIL = '<script>alert("$x_{$")<'


def test_page_of_two_data_sets_stands_alone(tmp_path):
    """Two seeds, odd names and a run that is left out."""
    top = fakes.write_experiment(tmp_path / "runs")
    fakes.write_run(top / "unfinished" / "seed0", {}, status="running")
    curve = {step: [50.0, 60.0] for step in range(1000, 8001, 1000)}
    fakes.write_run(top / EVIL / "seed0", curve, overrides=["x=</td>"])
    folder = tmp_path / "report" / "new"
    path = write_report(read_runs([top]), folder, reference="cql", command="made <so>")
    markup = path.read_text(encoding="utf-8")
    # Names cannot break the page, and it loads nothing.
    assert EVIL not in markup
    assert "&lt;script&gt;" in markup
    assert "made &lt;so&gt;" in markup
    assert not re.search("<(script|link|iframe|object)", markup)
    sources = re.findall(r'(?:src|href)="([^"]*)"', markup)
    assert all(each.startswith(("data:image/png;base64,", "#")) for each in sources)
    # The figures and tables are files, too.
    embedded = [each.split(",")[1] for each in sources if each.startswith("data:")]
    files = {path.name: path.read_bytes() for path in folder.glob("*.png")}
    assert files.keys() == {"curves.png"}
    assert sorted(files.values()) == sorted(map(base64.b64decode, embedded))
    scores = pd.read_csv(folder / "scores.csv", index_col=["data", "method"])
    row = scores.loc["hopper medium-replay", "cql"]
    assert row["last low"] <= row["last"] <= row["last high"]
    assert f"{row['last']:.1f} [{row['last low']:.1f}, " in markup
    robustness = pd.read_csv(folder / "robustness-hand.csv")
    assert set(robustness["disturbance"]) == {"mass", "torque-20"}
    # The verdict comes first, and two seeds have none.
    first = markup[: markup.index("Learning curves")]
    assert "too few seeds (2 of 5)" in first
    assert "unfinished/seed0: not finished, its status is running" in first
    assert not re.search(r'<td class="(better|worse)"', markup)


def test_five_seeds_have_a_verdict(tmp_path):
    for shift in range(3):
        for seed in range(5):
            scores = [10.0 * shift + seed, 10.0 * shift + 2 * seed]
            path = tmp_path / "runs" / f"{shift}-{seed}"
            fakes.write_run(path, {4: scores, 5: scores}, seed=seed, choice=f"m{shift}")
    tables = read_runs([tmp_path / "runs"])
    first, second = (write_report(tables, tmp_path / name) for name in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    markup = first.read_text(encoding="utf-8")
    assert "m1 is better than m0 in undisturbed score on hopper" in markup
    assert markup.count('<td class="better">') == 2
    with pytest.raises(ValueError, match="no method 'iql'; there are: m0; m1"):
        write_report(tables, tmp_path, reference="iql")


def test_a_single_run_has_nothing_to_compare_with(tmp_path):
    fakes.write_run(tmp_path / "runs" / "a", {1: [1.0, 2.0]})
    markup = write_report(read_runs([tmp_path / "runs"]), tmp_path).read_text()
    assert "There is nothing to compare with osr" in markup
    assert not (tmp_path / "differences.csv").exists()
