"""Which runs are read, from folders and tables, and what is left out and why."""

from __future__ import annotations

import gzip
import json
import os
import platform
from pathlib import Path

import pytest
from lab.report import fakes

from torchrl_osr.lab.report import pack_runs, read_records, read_runs

CURVE = {1000: [10.0, 20.0], 2000: [30.0, 50.0]}


def test_values_of_a_run_are_those_of_its_files(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, seed=4, overrides=["loss=osr", "seed=4"])
    tables = fakes.read_all(tmp_path)
    assert tables.runs.iloc[0].to_dict() == {
        "folder": str(tmp_path / "a"),
        "method": "osr",
        "data": "hopper medium-replay",
        "seed": 4,
        "steps": 2000,
        "measure": "score",
        "data_score": 20,
        "overrides": "loss=osr seed=4",
        "versions": ["mujoco 4.0.0", "torch 2.13.0", "torchrl_osr 0.1.0"],
    }
    assert tables.settings["loss.recovery_weight"].tolist() == ["0.5"]
    assert tables.episodes["step"].tolist() == [1000, 1000, 2000, 2000]
    assert tables.episodes["score"].tolist() == pytest.approx([10, 20, 30, 50])
    assert tables.episodes["episode"].tolist() == [10_000, 10_001] * 2


def test_a_folder_given_twice_counts_once(tmp_path):
    fakes.write_run(tmp_path / "top" / "a", CURVE)
    tables = read_runs([tmp_path, tmp_path / "top", tmp_path / "top" / "a"])
    assert (len(tables.runs), tables.left_out) == (1, [])


def test_without_a_finished_run_there_is_no_report(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, status="running")
    with pytest.raises(ValueError, match=r"no finished run(.|\n)*status is running"):
        read_runs([tmp_path])


def test_a_run_whose_process_is_gone_is_left_out_as_killed(tmp_path):
    folder = fakes.write_run(tmp_path / "bad", CURVE)
    said = {"status": "running", "pid": 123, "host": platform.node()}
    fakes.write_json(folder / "status.json", said)
    fakes.write_run(tmp_path / "good", CURVE)
    ((_, why),) = read_runs([tmp_path]).left_out
    gone = f"process 123 on {platform.node()} is gone"
    assert why == f"not finished, its status is killed: {gone}"
    assert not (folder / ".lock").exists(), "to look leaves nothing behind"


def break_returns(folder: Path, **entries: object) -> None:
    path = folder / "returns.json"
    content = json.loads(path.read_text())
    content["evaluations"][-1].update(entries)
    path.write_text(json.dumps(content))


def write_config(folder: Path, text: str) -> None:
    (folder / "config.yaml").write_text(text)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda f: fakes.write_json(f / "status.json", {"status": "running"}),
         "not finished, its status is running"),
        (lambda f: fakes.write_json(
            f / "status.json", {"status": "failed", "error": "ValueError: x"}),
         "failed: ValueError: x"),
        (lambda f: (f / "returns.json").unlink(), "No such file"),
        (lambda f: (f / "returns.json").write_text("{"), "returns.json is no JSON"),
        (lambda f: (f / "returns.json").write_text("[" * 10**5), "is no JSON"),
        (lambda f: (f / "returns.json").write_text("{}"), "no entry 'data_score'"),
        (lambda f: fakes.write_json(
            f / "returns.json", {"data_score": None, "evaluations": 7}), "int"),
        (lambda f: os.truncate(f / "returns.json", 10**9), "268,435,456 bytes"),
        (lambda f: os.truncate(f / "config.yaml", 10**9), "65,536 bytes"),
        (lambda f: write_config(f, "a: [1"), "while parsing"),
        (lambda f: write_config(f, "other: 1"), "no entry"),
        (lambda f: write_config(f, "[" * 200 + "]" * 200), "more than 32 deep"),
        (lambda f: write_config(f, "[" * 10**4), "more than 32 deep"),
        (lambda f: write_config(f, "a: &a [1]\nb: *a"), "aliases"),
        (lambda f: break_returns(f, step=1500), "last at step 1500 of 2000"),
        (lambda f: (f / ".hydra" / "hydra.yaml").unlink(), "No such file"),
        (lambda f: break_returns(f, returns=[1.0]), "must be of the same length"),
        (lambda f: break_returns(f, returns=[], seeds=[]), "no episodes"),
        (lambda f: break_returns(f, returns=[1, float("nan")]), "not finite"),
        (lambda f: break_returns(f, returns=[1, 1e308]), "beyond 1e+12"),
    ],
)  # fmt: skip
def test_a_foreign_or_damaged_run_is_left_out_and_named(tmp_path, spoil, reason):
    spoil(fakes.write_run(tmp_path / "bad", CURVE))
    fakes.write_run(tmp_path / "good", CURVE)
    tables = read_runs([tmp_path])
    ((path, why),) = tables.left_out
    assert tables.runs["folder"].tolist() == [str(tmp_path / "good")]
    assert path == str(tmp_path / "bad")
    assert reason in why
    assert len(why) <= 300


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        ({"format": 2}, "its format is 2, known is 1"),
        ({"evaluations": []}, "needs evaluations"),
        ({"evaluations": fakes.hand_suite(
            (4, [1], [1.0], [fakes.hand_level("x", [1.0])]),
            (5, [1], [1.0], [fakes.hand_level("y", [1.0])]),
        )["evaluations"]}, "all of the same levels"),
        ({"evaluations": [{}]}, "no entry"),
        ({"suite": ""}, "need names"),
        ({"evaluations": [[]]}, "TypeError"),
    ],
)  # fmt: skip
def test_a_broken_robustness_file_leaves_the_run_in(tmp_path, spoil, reason):
    content = fakes.hand_suite((5, [1], [1.0], [fakes.hand_level("x", [1.0])]))
    fakes.write_hand(tmp_path / "a", {5: [1.0]}, suite=content | spoil)
    tables = read_runs([tmp_path])
    assert tables.suites == []
    ((path, why),) = tables.left_out
    assert path == f"{tmp_path}/a/robustness-hand.json"
    assert reason in why


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"scores": [1.0]}, "must be of the same length"),
        ({"scores": [1.0, None]}, "missing or not finite"),
        ({"disturbed_at": [1]}, "must be of the same length"),
        ({"distance": {"offset": [1e15], "mean": [1], "count": [1]}}, "beyond 1e+12"),
        ({"distance": {"offset": [-1], "mean": [1], "count": [1]}}, "no distance"),
    ],
)  # fmt: skip
def test_a_disturbance_that_makes_no_sense_is_left_out(tmp_path, entries, reason):
    level = fakes.knock("x", [1.0, 2.0]) | entries
    content = fakes.hand_suite((5, [1, 2], [1.0, 2.0], [level]))
    fakes.write_hand(tmp_path / "a", {5: [1.0]}, suite=content)
    ((_, why),) = read_runs([tmp_path]).left_out
    assert reason in why


def test_a_packed_table_holds_all_that_the_folders_do(tmp_path):
    top = fakes.write_experiment(tmp_path / "runs", seeds=(0,))
    table = tmp_path / "runs.jsonl.gz"
    assert pack_runs([top / "hopper-medium-replay", top], table) == 8
    packed, loose = (fakes.read_all(each) for each in (table, top))
    for frame in ("episodes", "distances"):
        assert getattr(packed, frame).equals(getattr(loose, frame))
    assert packed.settings.equals(loose.settings)
    assert packed.methods == loose.methods
    first = next(read_records(table))
    assert first["folder"] == "hopper-medium-replay/cql/seed0"
    returns = top / first["folder"] / "returns.json"
    assert first["returns"] == json.loads(returns.read_text())
    before = table.read_bytes()
    pack_runs([top], table)
    assert table.read_bytes() == before
    fakes.write_run(top / "unfinished", CURVE, status="running")
    with pytest.raises(ValueError, match="status is running"):
        pack_runs([top], table)
    assert table.read_bytes() == before


def test_a_damaged_line_or_end_of_a_table_is_left_out(tmp_path):
    for name in ("a", "b"):
        fakes.write_run(tmp_path / "runs" / name, CURVE, seed=ord(name))
    table = tmp_path / "runs.jsonl.gz"
    pack_runs([tmp_path / "runs"], table)
    first, last = gzip.decompress(table.read_bytes()).splitlines(keepends=True)
    table.write_bytes(gzip.compress(first + b"[1]\n" + b"[" * 10**5 + b"\n" + last))
    tables = read_runs([table])
    assert tables.runs["seed"].tolist() == [97, 98]
    assert [each.path for each in tables.left_out] == [
        f"{table}, line 2", f"{table}, line 3",
    ]  # fmt: skip
    table.write_bytes(gzip.compress(first) + gzip.compress(last)[:-9])
    tables = read_runs([table])
    assert len(tables.runs) <= 2
    assert "damaged" in tables.left_out[-1].reason
    table.write_bytes(first)
    with pytest.raises(ValueError, match="no finished run"):
        read_runs([table])


def test_a_table_that_unpacks_to_too_much_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr("torchrl_osr.lab.report.runs.MAX_TABLE_BYTES", 2 * 10**6)
    fakes.write_run(tmp_path / "a", CURVE)
    (tmp_path / "bomb.jsonl.gz").write_bytes(gzip.compress(b"\n" * 10 + b" " * 10**7))
    tables = read_runs([tmp_path / "a", tmp_path / "bomb.jsonl.gz"])
    assert len(tables.runs) == 1
    assert "unpacks to more than 2,000,000 bytes" in tables.left_out[-1].reason
