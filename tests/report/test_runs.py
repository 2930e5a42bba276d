"""Which runs are read, what they are called, and which are kept apart."""

from __future__ import annotations

import json
import os
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_osr.report.checks import cells, comparison_notes, methods_of
from torchrl_osr.report.methods import name_methods
from torchrl_osr.report.page import choose_reference, collect
from torchrl_osr.report.robustness import name_suites, suites_of
from torchrl_osr.report.runs import find_runs

HERE = Path(__file__)
fakes = SimpleNamespace(**runpy.run_path(str(HERE.with_name("fakes.py"))))
ARCHIVE = HERE.parents[2] / "results" / "family" / "runs"
CURVE = {1000: [10.0, 20.0], 2000: [30.0, 50.0]}


def named(*folders: Path):
    return name_methods(find_runs(folders)[0])


def test_values_of_a_run_are_those_of_its_files(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, seed=4, overrides=["loss=osr", "seed=4"])
    ((run,), _) = find_runs([tmp_path])
    assert (run.env, run.data, run.seed, run.steps) == (
        "hopper", "hopper medium-replay", 4, 2000,
    )  # fmt: skip
    assert run.overrides == ("loss=osr", "seed=4")
    assert run.data_score == 20
    assert run.config["loss.recovery_weight"] == 0.5
    assert [row["step"] for row in run.evaluations] == [1000, 2000]


def test_a_folder_given_twice_counts_once_and_a_missing_one_is_an_error(tmp_path):
    fakes.write_run(tmp_path / "top" / "a", CURVE, overrides=[])
    runs, left_out = find_runs([tmp_path, tmp_path / "top", tmp_path / "top" / "a"])
    assert (len(runs), left_out) == (1, [])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        find_runs([tmp_path / "nowhere"])


def break_returns(folder: Path, **entries: object) -> None:
    path = folder / "returns.json"
    content = json.loads(path.read_text())
    content["evaluations"][-1].update(entries)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda f: fakes.write_json(f / "status.json", {"status": "running"}),
         "not finished, its status is running"),
        (lambda f: fakes.write_json(
            f / "status.json", {"status": "failed", "error": "ValueError: x"}),
         "failed: ValueError: x"),
        (lambda f: (f / "returns.json").unlink(), "there is no returns.json"),
        (lambda f: (f / "returns.json").write_text("{"), "returns.json is no JSON"),
        (lambda f: (f / "config.yaml").write_text("a: [1"), "while parsing"),
        (lambda f: (f / "config.yaml").write_text("other: 1"), "no entry 'env.name'"),
        (lambda f: break_returns(f, step=1500), "last at step 1500 of 2000"),
        (lambda f: break_returns(f, seeds=[1]), "returns and seeds of step 2000"),
        (lambda f: break_returns(f, seeds=[1, 2]), "have other seeds"),
        (lambda f: break_returns(f, returns=[1, float("nan")]), "not finite"),
    ],
)  # fmt: skip
def test_what_is_not_finished_or_broken_is_left_out_and_named(tmp_path, spoil, reason):
    spoil(fakes.write_run(tmp_path / "bad", CURVE))
    fakes.write_run(tmp_path / "good", CURVE)
    runs, ((path, why),) = find_runs([tmp_path])
    assert [run.folder.name for run in runs] == ["good"]
    assert path == tmp_path / "bad"
    assert reason in why


def test_what_is_far_too_large_is_left_out(tmp_path):
    for number, name in enumerate(("returns.json", "config.yaml")):
        folder = tmp_path / str(number)
        fakes.write_run(folder, CURVE)
        os.truncate(folder / name, 10**9)  # a hole: no byte of it is on the disk
    runs, left_out = find_runs([tmp_path])
    assert runs == []
    assert [each.reason for each in left_out] == [
        "returns.json has more than 268,435,456 bytes",
        "config.yaml has more than 65,536 bytes",
    ]


def test_a_broken_robustness_file_leaves_the_run_in(tmp_path):
    run = fakes.write_experiment(
        tmp_path, data=("hopper-medium-replay",), seeds=(0,)
    ) / "hopper-medium-replay" / "osr" / "seed0"  # fmt: skip
    path = run / "robustness-oos.json"
    content = json.loads(path.read_text())
    for spoil, reason in (
        ({"format": 2}, "its format is 2, known is 1"),
        ({"evaluations": []}, "no evaluations"),
        ({"evaluations": [{}]}, "no entry"),
    ):
        fakes.write_json(path, content | spoil)
        runs, ((where, why),) = find_runs([run])
        assert runs[0].suites == {}
        assert where == path
        assert reason in why
    content["evaluations"][1]["levels"][0]["scores"].pop()
    fakes.write_json(path, content)
    assert "scores and seeds do not match" in find_runs([run])[1][0].reason


def test_losses_are_known_by_their_values():
    # The archive's folders have the names of the options and nothing but their values.
    runs, left_out = named(ARCHIVE)
    assert not left_out
    assert {run.method for run in runs} == {path.name for path in ARCHIVE.iterdir()}
    assert all(run.method == run.folder.name for run in runs)


def test_names_come_from_the_layout_then_the_command_line(tmp_path):
    laid_out = tmp_path / "hopper-medium-replay" / "my method" / "seed0"
    fakes.write_run(laid_out, CURVE, overrides=["loss=cql"])
    fakes.write_run(tmp_path / "b", CURVE, overrides=["loss=osr_10", "seed=0"])
    assert [run.method for run in named(laid_out, tmp_path / "b")[0]] == [
        "my method", "osr_10",
    ]  # fmt: skip


def test_a_folder_that_contradicts_its_run_is_left_out(tmp_path):
    folder = tmp_path / "hopper-medium-replay" / "osr" / "seed1"
    fakes.write_run(folder, CURVE, seed=2)
    runs, ((path, reason),) = named(tmp_path)
    assert (runs, path) == ([], folder)
    assert "seed1" in reason
    assert "seed2" in reason


def test_other_budgets_and_settings_are_never_averaged(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, overrides=[])
    fakes.write_run(tmp_path / "b", CURVE, overrides=[], seed=1)
    longer = CURVE | {4000: [1.0, 2.0]}
    fakes.write_run(tmp_path / "c", longer, overrides=[], seed=2)
    wider = {"perturbation.std": 0.1}
    fakes.write_run(tmp_path / "d", CURVE, overrides=[], seed=3, changes=wider)
    runs, _ = named(tmp_path)
    assert {
        method: sorted(run.seed for run in group)
        for (_, method), group in cells(runs).items()
    } == {
        "osr (2,000 steps, perturbation.std=0.001)": [0, 1],
        "osr (4,000 steps, perturbation.std=0.001)": [2],
        "osr (2,000 steps, perturbation.std=0.1)": [3],
    }
    notes = comparison_notes(runs)
    assert any("different settings" in note and "4,000 steps" in note for note in notes)
    assert not any("perturbation" in note.split("(")[0] for note in notes)


def test_a_preset_names_what_it_changes(tmp_path):
    changes = {"network.num_cells": [256, 256], "optim.gamma": 0.9, "num_random": 10}
    fakes.write_run(tmp_path / "a", CURVE, overrides=["loss=osr"])
    fakes.write_run(tmp_path / "b", {5000: [1.0]}, changes=changes,
                    overrides=["loss=osr", "preset=paper"])  # fmt: skip
    assert methods_of(named(tmp_path)[0]) == [
        "osr (preset of the defaults, 2,000 steps)", "osr (preset paper, 5,000 steps)",
    ]  # fmt: skip


def test_what_does_not_fit_into_a_name_still_keeps_runs_apart(tmp_path):
    keys = ("a", "b", "c", "d")
    for seed, last in enumerate((1, 2, 2)):
        changes = {f"optim.{key}": seed for key in keys[:3]} | {"optim.d": last}
        changes |= {f"optim.{key}": 0 for key in keys[:3]} if seed == 1 else {}
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    names = methods_of(named(tmp_path)[0])
    assert len(names) == 3
    assert names[0] == "osr (optim.a=0, optim.b=0, optim.c=0 and 1 more, kind 1)"


def test_how_numbers_are_computed_keeps_no_runs_apart(tmp_path):
    for seed in (0, 1):
        changes = {"trainer.num_threads": seed, "loss.chunk_size": seed}
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    runs, _ = named(tmp_path)
    assert methods_of(runs) == ["osr"]
    assert not any("different settings" in note for note in comparison_notes(runs))


def test_a_key_that_older_runs_lack_keeps_apart_only_who_uses_it(tmp_path):
    lacking, as_before, other = {}, {"data.reward_scale": 1.0}, {"data.reward_scale": 9}
    for seed, changes in enumerate((lacking, as_before)):
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    runs, _ = named(tmp_path)
    assert methods_of(runs) == ["osr"]
    assert not any("different settings" in note for note in comparison_notes(runs))
    fakes.write_run(tmp_path / "2", CURVE, seed=2, changes=other)
    runs, _ = named(tmp_path)
    assert len(set(methods_of(runs))) == 2


def test_a_second_run_of_a_seed_is_no_second_seed(tmp_path):
    for name in ("a", "b"):
        fakes.write_run(tmp_path / name, CURVE)
    runs, ((path, reason),) = named(tmp_path)
    assert [run.folder.name for run in runs] == ["a"]
    assert path == tmp_path / "b"
    assert str(tmp_path / "a") in reason


def test_random_rows_make_another_data_set(tmp_path):
    for share in (0.0, 0.5):
        changes = {"data.random_share": share}
        fakes.write_run(tmp_path / str(share), CURVE, changes=changes)
    runs, _ = named(tmp_path)
    assert [run.data for run in runs] == [
        "hopper medium-replay", "hopper medium-replay, 50 % random",
    ]  # fmt: skip
    assert methods_of(runs) == ["osr"]


def test_unlike_versions_seeds_and_data_are_said(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, versions={"torch": "1"})
    fakes.write_run(tmp_path / "b", CURVE, seed=1, versions={"torch": "2"})
    fakes.write_run(tmp_path / "c", CURVE, loss=fakes.LOSSES["cql"], data_score=7)
    fakes.write_run(tmp_path / "d", CURVE, env="walker2d")
    text = "\n".join(comparison_notes(collect([tmp_path])[0]))
    assert (
        "Mixed versions of torch. 1: osr (1 run); 2: osr (1 run); not recorded" in text
    )
    assert "data's own score=20.0" in text
    assert "data's own score=7.0" in text
    assert "different seeds: 0, 1 (osr); 0 (cql)" in text
    assert "cql has no run on walker2d medium-replay" in text


def test_nothing_to_note_about_equals(tmp_path):
    runs, left_out = collect([fakes.write_experiment(tmp_path, seeds=(0, 1))])
    assert comparison_notes(runs) == left_out == []


def test_suites_played_differently_are_not_one_suite(tmp_path):
    top = fakes.write_experiment(tmp_path, data=("hopper-medium-replay",), seeds=(0, 1))
    path = top / "hopper-medium-replay" / "osr" / "seed1" / "robustness-oos.json"
    content = json.loads(path.read_text())
    content["evaluations"] = content["evaluations"][:1]
    fakes.write_json(path, content)
    runs, _ = named(top)
    assert suites_of(name_suites(runs)) == [
        "oos (checkpoints=last 2, episodes=20, other episode seeds)",
        "oos (checkpoints=[7000], episodes=10, other episode seeds)",
    ]  # fmt: skip


def test_without_a_finished_run_there_is_no_report(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, status="running")
    with pytest.raises(ValueError, match=r"no finished run(.|\n)*status is running"):
        collect([tmp_path])


def test_the_reference_is_the_first_or_one_that_exists(tmp_path):
    runs, _ = collect([fakes.write_experiment(tmp_path, seeds=(0,))])
    assert choose_reference(runs, None) == "cql"
    assert choose_reference(runs, "osr_v") == "osr_v"
    with pytest.raises(ValueError, match="there are: cql; cql_noisy_bc; osr; osr_v"):
        choose_reference(runs, "iql")


def test_all_of_the_experiment_is_read(tmp_path):
    runs = fakes.read_all(fakes.write_experiment(tmp_path, seeds=(0,)))
    assert {run.data for run in runs} == {
        "hopper medium-replay",
        "walker2d medium-expert",
    }
    assert len(runs) == 8
    assert all(set(run.suites) == {"oos"} for run in runs)
    assert all(run.versions == fakes.VERSIONS for run in runs)
