"""Which recoverable states each method saves, and files that make no sense."""

from __future__ import annotations

from pathlib import Path

import pytest
from lab.report import fakes

from torchrl_osr.lab.report import read_runs, write_report
from torchrl_osr.lab.report.saved import saved_states

GROUP = ["easy", "contested", *["recoverable"] * 4]
DISTURBANCE = ["push 1", "push 1", "kick 2", "kick 10", "kick 2", "kick 10"]
WALK = [0, 0, 1, 1, 2, 2]


def states(*back: list[int], **entries) -> dict:
    """A file's content, with what each checkpoint came back from."""
    content = {
        "format": 1,
        "versions": fakes.VERSIONS,
        "half": "public",
        "group": GROUP,
        "disturbance": DISTURBANCE,
        "walk": WALK,
        "evaluations": [{"step": 1000, "back": each} for each in back],
    }
    return content | entries


def write(top: Path, method: str, seed: int, content: dict) -> None:
    folder = top / method / f"seed{seed}"
    fakes.write_run(folder, {8000: [50.0]}, seed=seed, loss=fakes.LOSSES[method])
    fakes.write_json(folder / "recoverable-public.json", content)


@pytest.fixture
def top(tmp_path) -> Path:
    # Two checkpoints of each: the easy state always, a hard one in half of them.
    for seed in (0, 1):
        write(tmp_path, "cql", seed, states([1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]))
        both = [1, 1, 1, 1, 0, 0], [1, 1, 1, 0, 0, seed]
        write(tmp_path, "osr", seed, states(*both))
    return tmp_path


def test_shares_and_what_is_recovered(top) -> None:
    tables = fakes.read_all(top)
    cql, osr = saved_states(tables, "cql")
    assert (cql.data, cql.method, cql.seeds) == ("hopper medium-replay", "cql", [0, 1])
    assert cql.shares["easy"].mean == osr.shares["contested"].mean == 100
    assert cql.shares["recoverable"].mean == 0
    # 3 of 8 and 4 of 8, over two checkpoints each.
    assert osr.shares["recoverable"].mean == pytest.approx(43.75)
    # "kick 2" is the third and the fifth state: one of two, in all checkpoints.
    assert list(osr.by_disturbance) == ["kick 2", "kick 10"]
    assert osr.by_disturbance["kick 2"].mean == pytest.approx(50)
    assert osr.by_disturbance["kick 10"].mean == pytest.approx(37.5)
    assert cql.recovered is None, "it is the reference itself"
    assert osr.recovered.mean == pytest.approx(43.75), "the reference saves nothing"
    assert osr.recovered.over == "two seeds"


def test_nothing_is_recovered_where_the_reference_saves_all(top) -> None:
    everything = states([1, 1, 1, 1, 1, 1])
    for seed in (0, 1):
        write(top, "cql", seed, everything)
    assert list(saved_states(fakes.read_all(top), "cql"))[1].recovered is None


def test_other_states_have_a_row_of_their_own(top) -> None:
    group = [*GROUP[:-1], "easy"]
    write(top, "cql", 2, states([1, 0, 0, 0, 0, 1], group=group))
    found = list(saved_states(fakes.read_all(top), "cql"))
    assert [each.seeds for each in found] == [[0, 1], [0, 1], [2]]
    assert len({each.states for each in found}) == 2
    assert found[2].shares["easy"].mean == 100
    assert found[2].shares["easy"].over == "walks"


def test_the_page_has_the_table(top, tmp_path) -> None:
    page = write_report(read_runs([top]), tmp_path / "report").read_text()
    assert "<h3>Recoverable states</h3>" in page
    assert "43.8 %" in page
    assert "R against cql" in page
    by_disturbance = page.partition("Recoverable states by disturbance")[2]
    assert by_disturbance.index("kick 2") < by_disturbance.index("kick 10")
    assert "37.5 %" in by_disturbance


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        ({"format": 2}, "its format is 2, known is 1"),
        ({"group": GROUP[:-1]}, "5 states, and answers of the shape (1, 6)"),
        ({"walk": WALK[:-1]}, "same length"),
        ({"evaluations": []}, "answers of the shape (0,)"),
        ({"evaluations": [{"back": [2] * 6}]}, "not 0 or 1"),
        ({"group": ["lost"] * 6}, "groups are none of"),
        ({"half": None, "walk": "abcdef"}, "invalid literal"),
    ],
)
def test_a_broken_file_leaves_the_run_in(tmp_path, spoil, reason) -> None:
    write(tmp_path, "osr", 0, states([1] * 6) | spoil)
    tables = read_runs([tmp_path])
    assert len(tables.runs) == 1
    assert tables.saved.empty
    ((path, why),) = tables.left_out
    assert path.endswith("osr/seed0/recoverable-public.json")
    assert reason in why
