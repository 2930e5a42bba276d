"""The page, its tables and its figures."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import pandas as pd
import pytest
from lab.report import fakes

from torchrl_osr.lab.report import read_runs, write_report

EVIL = '<script>alert("$x_{$")<'


class Outline(HTMLParser):
    """Checks that tags are balanced; keeps tags and links."""

    def __init__(self, markup: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.feed(markup)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.sources += [value for key, value in attributes if key in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> SimpleNamespace:
    """A report of two data sets, with odd names and a run that is left out."""
    top = fakes.write_experiment(tmp_path_factory.mktemp("runs"))
    fakes.write_run(top / "unfinished" / "seed0", {}, status="running")
    curve = {step: [50.0, 60.0] for step in range(1000, 8001, 1000)}
    fakes.write_run(top / EVIL / "seed0", curve, overrides=["x=</td>"])
    folder = tmp_path_factory.mktemp("report") / "new"
    path = write_report(read_runs([top]), folder, reference="cql", command="made <so>")
    return SimpleNamespace(markup=path.read_text(encoding="utf-8"), folder=folder)


def test_page_stands_alone(report):
    outline = Outline(report.markup)
    assert not {"script", "link", "iframe", "object"} & set(outline.tags)
    for source in outline.sources:
        assert source.startswith(("data:image/png;base64,", "#"))
    embedded = [each for each in outline.sources if each.startswith("data:")]
    pictures = [base64.b64decode(each.split(",")[1]) for each in embedded]
    files = {path.name: path.read_bytes() for path in report.folder.glob("*.png")}
    assert files.keys() == {"curves.png", "differences.png", "recovery.png"}
    assert sorted(files.values()) == sorted(pictures)


def test_names_cannot_break_the_page(report):
    assert EVIL not in report.markup
    assert "&lt;script&gt;" in report.markup
    assert "made &lt;so&gt;" in report.markup


def test_the_verdict_comes_first_and_few_seeds_have_none(report):
    first = report.markup[: report.markup.index("Learning curves")]
    assert "too few seeds (2 of 5)" in first
    assert "unfinished/seed0: not finished, its status is running" in first
    assert not re.search(r'<td class="(better|worse)"', report.markup)


def test_tables_are_csv_files_too(report):
    scores = pd.read_csv(report.folder / "scores.csv", index_col=["data", "method"])
    row = scores.loc["hopper medium-replay", "cql"]
    assert row["last low"] <= row["last"] <= row["last high"]
    robustness = pd.read_csv(report.folder / "robustness-hand.csv")
    assert set(robustness["disturbance"]) == {"mass", "torque-20"}
    assert f"{row['last']:.1f} [{row['last low']:.1f}, " in report.markup


def test_five_seeds_have_a_verdict(tmp_path):
    for shift in range(7):
        for seed in range(5):
            scores = [10.0 * shift + seed, 10.0 * shift + 2 * seed]
            fakes.write_run(
                tmp_path / "runs" / f"{shift}-{seed}", {4: scores, 5: scores},
                seed=seed, choice=f"m{shift}",
            )  # fmt: skip
    tables = read_runs([tmp_path / "runs"])
    first, second = (write_report(tables, tmp_path / name) for name in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    markup = first.read_text(encoding="utf-8")
    Outline(markup)
    assert "m1 is better than m0 in undisturbed score on hopper" in markup
    assert markup.count('<td class="better">') == 6
    with pytest.raises(ValueError, match="no method 'iql'; there are: m0; m1"):
        write_report(tables, tmp_path, reference="iql")


def test_a_single_run_has_nothing_to_compare_with(tmp_path):
    fakes.write_run(tmp_path / "runs" / "a", {1: [1.0, 2.0]})
    markup = write_report(read_runs([tmp_path / "runs"]), tmp_path).read_text()
    assert "There is nothing to compare with osr" in markup
    assert not (tmp_path / "differences.png").exists()
