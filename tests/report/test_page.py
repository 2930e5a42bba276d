"""The page and its figures: whole, standing alone, and unbroken by what names hold."""

from __future__ import annotations

import base64
import json
import re
import runpy
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_osr.report.figures import method_styles
from torchrl_osr.report.html import (
    Cell,
    page,
    side_by_side,
    slug,
    table,
    text,
)
from torchrl_osr.report.page import collect, write_report

fakes = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("fakes.py"))))
EVIL = '<script>alert("$x_{$")<'
VOID = {"meta", "img"}


class Outline(HTMLParser):
    """Checks that tags are balanced; keeps texts, cells and what is linked."""

    def __init__(self, markup: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.feed(markup)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        attributes = dict(attributes)
        self.sources += [
            attributes[key] for key in ("src", "href") if key in attributes
        ]
        self.ids += [attributes["id"]] if "id" in attributes else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> SimpleNamespace:
    """A report of two data sets with all that may be wrong with runs."""
    top = fakes.write_experiment(tmp_path_factory.mktemp("runs"), seeds=(0, 1))
    hopper = top / "hopper-medium-replay"
    fakes.write_run(hopper / "osr_beta_0" / "seed0", {}, status="running")
    curve = {step: [50.0 + step / 1000, 60.0] for step in range(1000, 8001, 1000)}
    fakes.write_run(hopper / EVIL / "seed0", curve, overrides=["x=</td>"],
                    versions={"torch": "<b>2</b>"})  # fmt: skip
    fakes.write_run(hopper / "osr" / "seed2", curve | {9000: [1.0, 2.0]}, seed=2)
    path = hopper / "cql" / "seed0" / "robustness-oos.json"
    content = json.loads(path.read_text())
    content["versions"]["torch"] = "2.12.0"
    fakes.write_json(path, content)
    runs, left_out = collect([top])
    folder = tmp_path_factory.mktemp("report") / "new"
    path = write_report(runs, left_out, folder, reference="cql", command="made <so>")
    markup = path.read_text(encoding="utf-8")
    return SimpleNamespace(markup=markup, outline=Outline(markup), folder=folder)


def section(report, key: str) -> str:
    start = report.markup.index(f'<section id="{key}">')
    return report.markup[start : report.markup.index("</section>", start)]


def cells(markup: str) -> list[str]:
    """Texts of the cells of a table, without what stands small below."""
    return re.findall(r"<t[hd](?: [^>]*)?>([^<]*)", markup)


def test_page_stands_alone(report):
    assert report.markup.startswith("<!DOCTYPE html>")
    assert not {"script", "link", "iframe", "object"} & set(report.outline.tags)
    for source in report.outline.sources:
        assert source.startswith(("data:image/png;base64,", "#"))
    assert {s[1:] for s in report.outline.sources if s[0] == "#"} == set(
        report.outline.ids
    )
    assert "url(" not in report.markup
    assert "@import" not in report.markup


def test_figures_are_in_the_page_and_beside_it(report):
    pictures = {path.name: path.read_bytes() for path in report.folder.glob("*.png")}
    data = ("hopper-medium-replay", "walker2d-medium-expert")
    over_all = {"curves.png", "differences.png", "iqm.png", "profiles.png"}
    assert pictures.keys() == over_all | {
        f"{kind}-oos-{each}.png" for kind in ("strength", "recovery") for each in data
    }
    embedded = [
        base64.b64decode(source.split(",")[1])
        for source in report.outline.sources
        if source.startswith("data:")
    ]
    assert sorted(embedded) == sorted(pictures.values())
    assert all(each.startswith(b"\x89PNG") for each in embedded)
    assert [path.name for path in report.folder.iterdir() if path.name[0] == "."] == []


def test_names_cannot_break_the_page(report):
    assert text(EVIL) in report.markup
    assert EVIL not in report.markup
    assert "<b>" not in report.markup
    assert text("x=</td>") in report.markup
    assert text("made <so>") in report.markup


def test_what_is_not_alike_is_said_before_anything_else(report):
    head = report.markup[: report.markup.index("<section")]
    assert "Before you compare" in head
    assert "Mixed versions of torch" in head
    assert "osr (9,000 steps)" in head
    assert "1 folders or files" in head
    assert "not finished, its status is running" in section(
        report, "where-it-comes-from"
    )


def test_clean_table_has_each_method_once_with_its_seeds(report):
    found = cells(section(report, "undisturbed-scores"))
    assert found[:6] == [
        "method",
        "seeds",
        "steps",
        "last",
        "mean of the last 5",
        "data",
    ]
    start = found.index("cql †")
    assert found[start : start + 3] == ["cql †", "2 (0, 1)", "8,000"]
    assert re.fullmatch(r"\d+\.\d \[\d+\.\d, \d+\.\d\]", found[start + 3])
    start = found.index("osr (9,000 steps)")
    assert found[start + 1 : start + 4] == ["1 (2)", "9,000", "1.5 [1.0, 2.0] ᵉ"]
    assert found.count("osr (8,000 steps)") == 2


def test_disturbed_table_has_the_papers_numbers_in_a_frame_of_their_own(report):
    markup = section(report, "out-of-sample")
    own, paper = markup.split('<div class="paper">')
    names = [name for name, *_ in fakes.LEVELS]
    assert [name for name in cells(own) if name in names] == names
    assert len(re.findall(r"<small>\d+\.\d % \[.*?\]", own)) == len(names) * 4 * 2
    assert "another data set (D4RL)".lower() in paper.lower()
    assert "Table 2 of" in paper
    assert "110.4" in paper  # CQL on Hopper-OOS-s
    assert "halfcheetah" not in paper  # no run of it


def test_differences_are_plain_sentences(report):
    markup = section(report, "differences")
    lines = re.findall(r"<li[^>]*>(.*?)</li>", markup)
    words = r"(?:is better than|is worse than|is not told apart from) cql: [+\u2212]\d"
    told = [line for line in lines if re.search(words, line)]
    refused = [line for line in lines if "are not paired" in line]
    assert len(told) + len(refused) == len(lines)
    # Three methods on two data sets and on both in three quantities. Of the other two
    # one has a seed of its own, and one other episodes.
    assert len(told) == 3 * 3 * 3
    assert len(refused) == 2
    assert any(line.startswith("all data sets, score under oos: osr") for line in told)


def test_recovery_table_counts_episodes(report):
    found = cells(section(report, "recovery"))
    shares = [each for each in found if re.fullmatch(r"\d+ % of 40", each)]
    assert len(shares) == 5 * 4 * 2


def test_the_same_runs_give_the_same_page(tmp_path):
    curve = {1: [1.0, 2.0]}
    fakes.write_run(tmp_path / "runs" / "a", curve, overrides=[])
    runs, left_out = collect([tmp_path / "runs"])
    first, second = (
        write_report(runs, left_out, tmp_path / name, reference="osr", command="c")
        for name in ("one", "two")
    )
    assert first.read_bytes() == second.read_bytes()
    markup = first.read_text()
    Outline(markup)
    assert "No run has been disturbed" in markup
    assert "There is nothing to compare with osr" in markup


def test_tables_are_whole():
    assert "<td><small>" not in table(["a"], [("", [["b"]])])
    with pytest.raises(ValueError, match="a row of 1 cells in a table of 2"):
        table(["a", "b"], [("", [["c"]])])
    markup = table(["a", "b"], [("<g>", [["c", Cell("d&", "<e>", "none")]])], "f")
    Outline(markup)
    assert "&lt;g&gt;" in markup
    assert '<td class="none">d&amp;<small>&lt;e&gt;</small></td>' in markup
    Outline(page("t", "", [("A b", "")]))


def test_names_of_files_are_safe():
    assert slug("../Hopper medium-replay, 50 %") == "hopper-medium-replay-50"
    assert slug("$$$") == "unnamed"


def test_columns_are_shared_out_evenly():
    assert [list(each) for each in side_by_side(range(7))] == [[0, 1, 2], [3, 4, 5, 6]]
    assert [len(each) for each in side_by_side(range(12))] == [4, 4, 4]
    assert side_by_side([]) == []


def test_methods_can_be_told_apart():
    styles = method_styles([str(number) for number in range(20)])
    assert len({(style.color, str(style.line)) for style in styles.values()}) == 20
