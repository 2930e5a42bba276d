"""What runs are called, which are kept apart, and what is said about comparisons."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from types import SimpleNamespace

from torchrl_osr.report import comparison_notes, read_runs

fakes = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("fakes.py"))))
CURVE = {1000: [10.0, 20.0], 2000: [30.0, 50.0]}


def test_names_come_from_the_layout_the_choice_the_command_line_or_the_class(tmp_path):
    laid_out = tmp_path / "hopper-medium-replay" / "my method" / "seed0"
    fakes.write_run(laid_out, CURVE, overrides=["loss=cql"], choice="cql")
    fakes.write_run(tmp_path / "b", CURVE, overrides=["seed=0"], choice="osr_10")
    fakes.write_run(tmp_path / "c", CURVE, overrides=["loss=sac_10"])
    fakes.write_run(tmp_path / "d", CURVE)
    paths = [laid_out, *(tmp_path / name for name in "bcd")]
    assert read_runs(paths).methods == ["my method", "osr_10", "sac_10", "osr"]


def test_a_folder_that_contradicts_its_run_is_left_out(tmp_path):
    folder = tmp_path / "hopper-medium-replay" / "osr" / "seed1"
    fakes.write_run(folder, CURVE, seed=2)
    fakes.write_run(tmp_path / "other", CURVE)
    ((path, reason),) = read_runs([tmp_path]).left_out
    assert path == str(folder)
    assert "seed1" in reason
    assert "seed2" in reason


def test_other_budgets_and_settings_are_never_averaged(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE)
    fakes.write_run(tmp_path / "b", CURVE, seed=1)
    fakes.write_run(tmp_path / "c", CURVE | {4000: [1.0, 2.0]}, seed=2)
    wider = {"perturbation.std": 0.1}
    fakes.write_run(tmp_path / "d", CURVE, seed=3, changes=wider)
    tables = fakes.read_all(tmp_path)
    assert {
        method: sorted(run.seed for run in group)
        for (_, method), group in tables.cells().items()
    } == {
        "osr (2,000 steps, perturbation.std=0.001)": [0, 1],
        "osr (4,000 steps, perturbation.std=0.001)": [2],
        "osr (2,000 steps, perturbation.std=0.1)": [3],
    }
    notes = comparison_notes(tables)
    assert any("different settings" in note and "4,000 steps" in note for note in notes)
    assert not any("perturbation" in note.split("(")[0] for note in notes)


def test_what_does_not_fit_into_a_name_still_keeps_runs_apart(tmp_path):
    for seed, last in enumerate((1, 2, 2)):
        changes = {f"optim.{key}": 0 if seed == 1 else seed for key in "abc"}
        changes |= {"optim.d": last}
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    names = fakes.read_all(tmp_path).methods
    assert len(names) == 3
    assert names[0] == "osr (optim.a=0, optim.b=0, optim.c=0 and 1 more, kind 1)"


def test_where_a_class_is_imported_from_is_not_shown(tmp_path):
    for name in ("tanh_gaussian", "cvae"):
        changes = {"inverse_dynamics.network": {"_target_": f"torchrl_osr.{name}"}}
        fakes.write_run(tmp_path / name, CURVE, changes=changes)
    assert set(fakes.read_all(tmp_path).methods) == {
        "osr (inverse_dynamics.network=tanh_gaussian)",
        "osr (inverse_dynamics.network=cvae)",
    }


def test_how_numbers_are_computed_keeps_no_runs_apart(tmp_path):
    for seed in (0, 1):
        changes = {"trainer.num_threads": seed, "loss.chunk_size": seed}
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    tables = fakes.read_all(tmp_path)
    assert tables.methods == ["osr"]
    assert comparison_notes(tables) == []


def test_a_second_run_of_a_seed_is_no_second_seed(tmp_path):
    for name in ("a", "b"):
        fakes.write_run(tmp_path / name, CURVE)
    tables = read_runs([tmp_path])
    ((path, reason),) = tables.left_out
    assert len(tables.runs) == 1
    assert path == str(tmp_path / "b")
    assert str(tmp_path / "a") in reason


def test_random_rows_make_another_data_set(tmp_path):
    for share in (0.0, 0.5):
        changes = {"data.random_share": share}
        fakes.write_run(tmp_path / str(share), CURVE, changes=changes)
    tables = fakes.read_all(tmp_path)
    assert tables.methods == ["osr"]
    assert tables.data == ["hopper medium-replay", "hopper medium-replay, 50 % random"]


def test_unlike_versions_seeds_and_data_are_said(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE, versions={"torch": "1"})
    fakes.write_run(tmp_path / "b", CURVE, seed=1, versions={"torch": "2"})
    fakes.write_run(tmp_path / "c", CURVE, versions={}, data_score=7,
                    overrides=["loss=cql"])  # fmt: skip
    fakes.write_run(tmp_path / "d", CURVE, env="walker2d", versions={})
    text = "\n".join(comparison_notes(fakes.read_all(tmp_path)))
    assert "Mixed versions of torch. 1: osr (1 run); 2: osr (1 run)." in text
    assert "No versions are recorded of osr, cql (2 runs)" in text
    assert "the data's own score=20.0" in text
    assert "the data's own score=7.0" in text
    assert "different seeds: 0, 1 (osr); 0 (cql)" in text
    assert "cql has no run on walker2d medium-replay" in text


def test_there_is_nothing_to_note_about_equals(tmp_path):
    tables = fakes.read_all(fakes.write_experiment(tmp_path, seeds=(0, 1)))
    assert len(tables.runs) == 16
    assert tables.suites == ["oos"]
    assert comparison_notes(tables) == []


def test_suites_played_differently_are_not_one_suite(tmp_path):
    top = fakes.write_experiment(tmp_path, data=("hopper-medium-replay",), seeds=(0, 1))
    path = top / "hopper-medium-replay" / "osr" / "seed1" / "robustness-oos.json"
    content = json.loads(path.read_text())
    content["evaluations"] = content["evaluations"][:1]
    fakes.write_json(path, content)
    tables = fakes.read_all(top)
    assert tables.suites == [
        "oos (checkpoints=last 2, episodes=20, other episode seeds)",
        "oos (checkpoints=[7000], episodes=10, other episode seeds)",
    ]  # fmt: skip
    assert set(tables.episodes["suite"]) == {"", *tables.suites}
