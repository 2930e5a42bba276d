"""The page and its figures: whole, standing alone, and unbroken by what names hold."""

from __future__ import annotations

import base64
import json
import re
from html import escape
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest
from lab.report import fakes

from torchrl_osr.lab.cli.report import main
from torchrl_osr.lab.report import read_runs, write_report
from torchrl_osr.lab.report.page import slug
from torchrl_osr.lab.report.plots import MOST

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
    (fakes.write_run(hopper / "\udcff" / "seed0", curve) / "config.yaml").write_text(
        "[" * 200 + "]" * 200
    )
    path = hopper / "cql" / "seed0" / "robustness-hand.json"
    content = json.loads(path.read_text())
    content["versions"]["torch"] = "2.12.0"
    fakes.write_json(path, content)
    folder = tmp_path_factory.mktemp("report") / "new"
    path = write_report(read_runs([top]), folder, reference="cql", command="made <so>")
    markup = path.read_text(encoding="utf-8")
    return SimpleNamespace(markup=markup, outline=Outline(markup), folder=folder)


def section(report, key: str) -> str:
    start = report.markup.index(f'<section id="{key}">')
    return report.markup[start : report.markup.index("</section>", start)]


def cells(markup: str) -> list[str]:
    """Texts of the cells of a table, with what stands small below behind a space."""
    found = re.findall(r"<t[hd](?: [^>]*)?>(.*?)</t[hd]>", markup)
    return [re.sub(r"</?small>", " ", each).strip() for each in found]


def items(markup: str) -> list[str]:
    return re.findall(r"<li>(.*?)</li>", markup)


def test_page_stands_alone(report):
    assert report.markup.lstrip().startswith("<!DOCTYPE html>")
    assert not {"script", "link", "iframe", "object"} & set(report.outline.tags)
    for source in report.outline.sources:
        assert source.startswith(("data:image/png;base64,", "#"))
    linked = {each[1:] for each in report.outline.sources if each[0] == "#"}
    assert linked == set(report.outline.ids)
    assert "url(" not in report.markup
    assert "@import" not in report.markup


def test_figures_are_in_the_page_and_beside_it(report):
    pictures = {path.name: path.read_bytes() for path in report.folder.glob("*.png")}
    data = ("hopper-medium-replay", "walker2d-medium-expert")
    over_all = {"curves.png", "differences.png", "profiles.png"}
    assert pictures.keys() == over_all | {
        f"{kind}-{each}-suite-hand.png"
        for kind in ("distance", "recovered")
        for each in data
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
    assert str(escape(EVIL)).replace("&quot;", "&#34;") in report.markup
    assert EVIL not in report.markup
    assert "<b>" not in report.markup
    assert "x=&lt;/td&gt;" in report.markup
    assert "made &lt;so&gt;" in report.markup


def test_the_verdict_comes_first_and_few_seeds_have_none(report):
    first = report.markup[: report.markup.index('<section id="learning-curves">')]
    found = items(section(report, "verdict"))
    assert found[0].endswith("cannot be told: 2 seeds.")
    assert "A verdict needs 5 pairs of runs" in first
    assert first.index("cannot be told") < first.index("Before you compare")
    assert not re.search(r'class="(better|worse)"', report.markup), "no colour, either"
    assert "▲ " not in "".join(cells(report.markup))
    assert any("Mixed versions: torch 2.12.0" in each for each in found)
    assert "osr (trainer.steps=9000)" in first
    assert "2 runs or files of runs" in first


def test_what_is_left_out_is_named_with_the_reason(report):
    found = items(section(report, "where-it-comes-from"))
    assert "not finished, its status is running" in found[0] + found[1]
    assert "config.yaml is nested more than 32 deep" in found[0] + found[1]


def test_clean_table_has_each_method_once_with_its_seeds(report):
    found = cells(section(report, "undisturbed-scores"))
    head = ["method", "seeds", "steps", "last", "mean of the last 5", "data"]
    assert found[: len(head)] == head
    start = found.index("cql")
    assert found[start : start + 3] == ["cql", "2 (0, 1)", "8,000"]
    assert re.fullmatch(r"\d+\.\d \[\d+\.\d, \d+\.\d\] ²", found[start + 3])
    start = found.index("osr (trainer.steps=9000)")
    assert found[start + 1 : start + 4] == ["1 (2)", "9,000", "1.5 [1.0, 2.0] ᵉ"]
    assert found.count("osr (trainer.steps=8000)") == 2


def test_disturbed_table_has_scores_and_decreases(report):
    found = section(report, "out-of-sample")
    names = ["mass", "torque-20", "push-small"]
    assert [name for name in cells(found) if name in names] == names
    assert len(re.findall(r"<small>\d+\.\d % \[.*?\]", found)) == len(names) * 4 * 2


def test_differences_are_in_a_table_and_refusals_in_words(report):
    markup = section(report, "differences")
    table, by_disturbance = markup.split("Disturbance by disturbance")
    numbers = r"[+\u2212]\d+\.\d \[[+\u2212]\d+\.\d, [+\u2212]\d+\.\d\] ²"
    # Three methods on two data sets in three quantities. Of the other two one has a
    # seed of its own, and one other episodes.
    found = [each for each in cells(table) if re.fullmatch(numbers, each)]
    assert len(found) == 3 * 2 * 3
    assert sum("are not paired" in each for each in items(table)) == 2
    assert cells(table).count("not paired") == 2
    found = [each for each in cells(by_disturbance) if re.fullmatch(numbers, each)]
    assert len(found) == 3 * (2 + 1) * 3


def test_recovery_table_counts_episodes(report):
    found = cells(section(report, "recovery"))
    shares = [each for each in found if re.fullmatch(r"\d+ % of 40", each)]
    assert len(shares) == 2 * 4 * 2


def test_the_same_runs_give_the_same_page(tmp_path):
    curve = {step: [1.0, 2.0] for step in range(1, 5)}
    fakes.write_run(tmp_path / "runs" / "a", curve)
    tables = read_runs([tmp_path / "runs"])
    first, second = (write_report(tables, tmp_path / name) for name in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    markup = first.read_text(encoding="utf-8")
    Outline(markup)
    assert "No run has been disturbed" in markup
    assert "There is nothing to compare with osr" in markup
    assert "No run was disturbed by anything that ends" in markup
    with pytest.raises(ValueError, match="no method 'iql'; there are: osr"):
        write_report(tables, tmp_path, reference="iql")


def test_runs_whose_disturbances_all_last_have_no_recovery(tmp_path):
    scores = [1.0, 2.0]
    lasting = fakes.hand_suite((4, [0, 1], scores, [fakes.hand_level("mass", scores)]))
    fakes.write_hand(tmp_path / "runs" / "a", {4: scores}, suite=lasting)
    markup = write_report(read_runs([tmp_path / "runs"]), tmp_path).read_text()
    assert "No run was disturbed by anything that ends" in markup
    assert "No run has been disturbed" not in markup


def test_five_seeds_have_a_verdict_and_many_methods_small_panels(tmp_path):
    for shift in range(MOST + 1):
        for seed in range(5):
            scores = [10.0 * shift + seed, 10.0 * shift + 2 * seed]
            fakes.write_run(
                tmp_path / "runs" / f"{shift}-{seed}", {4: scores, 5: scores},
                seed=seed, choice=f"m{shift}",
            )  # fmt: skip
    path = write_report(read_runs([tmp_path / "runs"]), tmp_path / "page")
    markup = path.read_text(encoding="utf-8")
    Outline(markup)
    found = items(section(SimpleNamespace(markup=markup), "verdict"))
    assert found[0].startswith("m1 is better than m0 in undisturbed score on hopper")
    assert len(found) == MOST
    assert markup.count('<td class="better">') == MOST


def test_names_of_files_are_safe():
    assert slug("../Hopper medium-replay, 50 %") == "hopper-medium-replay-50"
    assert slug("$$$") == "unnamed"


def test_the_command_packs_runs_reports_on_them_and_says_what_is_missing(
    tmp_path, monkeypatch, capsys
):
    def run(*arguments: object) -> str:
        monkeypatch.setattr("sys.argv", ["report.py", *map(str, arguments)])
        main()
        return capsys.readouterr().out

    fakes.write_run(tmp_path / "runs" / "a", {1: [1.0, 2.0]})
    table, page = tmp_path / "runs.jsonl.gz", tmp_path / "page"
    assert "1 run in" in run(tmp_path / "runs", "--pack", table)
    output = run(table, "--output", page)
    assert "note: Every method has one seed" in output
    assert (page / "report.html").exists()
    with pytest.raises(SystemExit):
        run(tmp_path / "runs", table, "--pack", tmp_path / "all.jsonl.gz")
    assert f"--pack takes folders of runs, got {table}." in capsys.readouterr().err
