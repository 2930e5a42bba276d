"""What runs are called, which are kept apart, and what is said about comparisons."""

from __future__ import annotations

import json

from lab.report import fakes

from torchrl_osr.lab.report import comparison_notes, read_runs

CURVE = {1000: [10.0, 20.0], 2000: [30.0, 50.0]}


def test_names_come_from_the_layout_or_the_chosen_loss(tmp_path):
    laid_out = tmp_path / "hopper-medium-replay" / "my method" / "seed0"
    fakes.write_run(laid_out, CURVE, choice="cql")
    fakes.write_run(tmp_path / "seed5", CURVE, choice="osr_10", seed=1)
    assert read_runs([tmp_path]).methods == ["my method", "osr_10"]


def test_other_budgets_and_settings_are_never_averaged(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE)
    fakes.write_run(tmp_path / "b", CURVE, seed=1)
    fakes.write_run(tmp_path / "c", CURVE | {4000: [1.0, 2.0]}, seed=2)
    wider = {"perturbation.std": 0.1}
    fakes.write_run(tmp_path / "d", CURVE, seed=3, changes=wider)
    tables = fakes.read_all(tmp_path)
    assert tables.runs.groupby("method")["seed"].agg(list).to_dict() == {
        "osr (perturbation.std=0.001, trainer.steps=2000)": [0, 1],
        "osr (perturbation.std=0.001, trainer.steps=4000)": [2],
        "osr (perturbation.std=0.1, trainer.steps=2000)": [3],
    }
    notes = comparison_notes(tables)
    assert "hopper medium-replay: its runs differ in trainer.steps." in notes


def test_settings_that_change_no_number_keep_no_runs_apart(tmp_path):
    for seed, recorded in enumerate((True, False)):
        changes = {"trainer.record": recorded, "data.storage": ("memory", "disk")[seed]}
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    assert fakes.read_all(tmp_path).methods == ["osr"]


def test_what_is_chosen_by_the_data_keeps_no_runs_apart_and_is_said(tmp_path):
    for seed in (0, 1):
        for env, rate in (("hopper", 1e-3), ("walker2d", 3e-4)):
            changes = {"optim.actor_lr": rate, "loss.beta": seed * (env == "hopper")}
            folder = tmp_path / f"{env}{seed}"
            fakes.write_run(folder, CURVE, seed=seed, env=env, changes=changes)
    tables = fakes.read_all(tmp_path)
    assert tables.runs.groupby("method")["data"].agg(len).to_dict() == {
        "osr (loss.beta=0)": 3,
        "osr (loss.beta=1)": 1,
    }
    note = "osr (loss.beta=0) differs between data sets: optim.actor_lr."
    assert note in comparison_notes(tables)


def test_what_does_not_fit_into_a_name_still_keeps_runs_apart(tmp_path):
    for seed, last in enumerate((1, 2, 2)):
        changes = {f"optim.{key}": 0 if seed == 1 else seed for key in "abc"}
        changes |= {"optim.d": last}
        fakes.write_run(tmp_path / str(seed), CURVE, seed=seed, changes=changes)
    names = fakes.read_all(tmp_path).methods
    assert len(names) == 3
    changes = {"optim.a": "x" * 50}
    for seed in (0, 1):
        changes = {"optim.a": "x" * 50 + str(seed)}
        fakes.write_run(tmp_path / "b" / str(seed), CURVE, seed=seed, changes=changes)
    names = fakes.read_all(tmp_path / "b").methods
    text = f"osr (optim.a={'x' * 40}, kind "
    assert names == [f"{text}1)", f"{text}2)"]


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
    fakes.write_run(tmp_path / "c", CURVE, versions={}, data_score=7, choice="cql")
    fakes.write_run(tmp_path / "d", CURVE, env="walker2d", versions={})
    assert comparison_notes(fakes.read_all(tmp_path)) == [
        "Mixed versions: torch 1, torch 2.",
        "No versions are recorded of 2 runs.",
        "hopper medium-replay: its runs differ in data_score.",
        "hopper medium-replay: methods have different seeds: 0, 1 (osr); 0 (cql).",
    ]


def test_there_is_nothing_to_note_about_equals(tmp_path):
    tables = fakes.read_all(fakes.write_experiment(tmp_path, seeds=(0, 1)))
    assert len(tables.runs) == 16
    assert tables.suites == ["hand"]
    assert comparison_notes(tables) == []


def test_suites_played_differently_are_not_one_suite(tmp_path):
    top = fakes.write_experiment(tmp_path, data=("hopper-medium-replay",), seeds=(0, 1))
    path = top / "hopper-medium-replay" / "osr" / "seed1" / "robustness-hand.json"
    content = json.loads(path.read_text())
    content["evaluations"] = content["evaluations"][:1]
    fakes.write_json(path, content)
    tables = fakes.read_all(top)
    assert [name.partition(", seeds")[0] for name in tables.suites] == [
        "hand (checkpoints=last 2, episodes=20",
        "hand (checkpoints=[7000], episodes=10",
    ]
    assert set(tables.episodes["suite"]) == {"", *tables.suites}
