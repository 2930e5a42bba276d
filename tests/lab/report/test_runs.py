"""Which runs are read and averaged, what they are called, and what is left out."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from lab.report import fakes

from torchrl_osr.lab.report import comparison_notes, read_runs

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
        "measure": "normalised score",
        "data_score": 20,
        "overrides": "loss=osr seed=4",
        "versions": ["mujoco 4.0.0", "torch 2.13.0", "torchrl_osr 0.1.0"],
    }
    assert tables.settings["loss.recovery_weight"].tolist() == ["0.5"]
    assert tables.episodes["step"].tolist() == [1000, 1000, 2000, 2000]
    assert tables.episodes["score"].tolist() == pytest.approx([10, 20, 30, 50])
    assert tables.episodes["episode"].tolist() == [10_000, 10_001] * 2


def break_returns(folder: Path, **entries: object) -> None:
    path = folder / "returns.json"
    content = json.loads(path.read_text())
    content["evaluations"][-1].update(entries)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda f: fakes.write_json(
            f / "status.json", {"status": "failed", "error": "ValueError: x"}),
         "failed: ValueError: x"),
        (lambda f: (f / "returns.json").write_text("{"), "returns.json is no JSON"),
        (lambda f: (f / "returns.json").write_text("{}"), "KeyError('evaluations')"),
        (lambda f: break_returns(f, step=1500), "last evaluation at step 1500"),
        (lambda f: break_returns(f, returns=[1, None]), "finite numbers"),
    ],
)  # fmt: skip
def test_a_foreign_or_damaged_run_is_left_out_with_the_reason(tmp_path, spoil, reason):
    spoil(fakes.write_run(tmp_path / "bad", CURVE))
    good = fakes.write_run(tmp_path / "good", CURVE)
    shutil.copytree(good, good / "wandb" / "run-1" / "files")
    tables = read_runs([tmp_path])
    ((path, why),) = tables.left_out
    assert tables.runs["folder"].tolist() == [str(tmp_path / "good")]
    assert path == str(tmp_path / "bad")
    assert reason in why


def test_names_come_from_the_layout_or_the_chosen_loss(tmp_path):
    fakes.write_run(tmp_path / "my method" / "seed0", CURVE, choice="cql")
    fakes.write_run(tmp_path / "seed5", CURVE, choice="osr_10", seed=1)
    assert read_runs([tmp_path]).methods == ["my method", "osr_10"]


def test_other_budgets_and_settings_are_never_averaged(tmp_path):
    fakes.write_run(tmp_path / "a", CURVE)
    fakes.write_run(tmp_path / "b", CURVE, seed=1, versions={"torch": "1"})
    fakes.write_run(tmp_path / "c", CURVE | {4000: [1.0, 2.0]}, seed=2)
    changes = {"perturbation.std": 0.1}
    fakes.write_run(tmp_path / "d", CURVE, seed=3, changes=changes)
    tables = fakes.read_all(tmp_path)
    assert tables.runs.groupby("method")["seed"].agg(list).to_dict() == {
        "osr (perturbation.std=0.001, trainer.steps=2000)": [0, 1],
        "osr (perturbation.std=0.001, trainer.steps=4000)": [2],
        "osr (perturbation.std=0.1, trainer.steps=2000)": [3],
    }
    assert comparison_notes(tables) == [
        "Mixed versions: torch 1, torch 2.13.0.",
        "hopper medium-replay: its runs differ in trainer.steps.",
    ]


def test_settings_of_speed_or_chosen_by_the_data_keep_no_runs_apart(tmp_path):
    for seed in (0, 1):
        for env, rate in (("hopper", 1e-3), ("walker2d", 3e-4)):
            changes = {"optim.actor_lr": rate, "loss.beta": seed * (env == "hopper")}
            changes |= {"trainer.num_threads": seed, "trainer.compile": f"of {seed}"}
            folder = tmp_path / f"{env}{seed}"
            fakes.write_run(folder, CURVE, seed=seed, env=env, changes=changes)
    tables = fakes.read_all(tmp_path)
    sizes = tables.runs.groupby("method")["data"].agg(len).to_dict()
    assert sizes == {"osr (loss.beta=0)": 3, "osr (loss.beta=1)": 1}
    assert comparison_notes(tables) == []


def test_of_two_runs_of_a_seed_the_later_one_counts(tmp_path):
    for name, score in (("a", 1.0), ("b", 2.0)):
        fakes.write_run(tmp_path / name, {5: [score]})
    tables = read_runs([tmp_path])
    assert tables.left_out[0][0] == str(tmp_path / "a")
    assert str(tmp_path / "b") in tables.left_out[0][1]
    assert tables.episodes["score"].tolist() == pytest.approx([2.0])


def test_a_run_on_other_data_under_the_same_name_is_another_data_set(tmp_path):
    for name in ("a", "b"):  # the log was corrected, and has the same mean
        changes = {"data.checksum": f"{name}1234567890"}
        fakes.write_run(tmp_path / name, CURVE, changes=changes)
    changes = {"data.random_share": 0.5}
    fakes.write_run(tmp_path / "mixed", CURVE, changes=changes)
    assert fakes.read_all(tmp_path).data == [
        "hopper medium-replay (checksum=a1234567)",
        "hopper medium-replay (checksum=b1234567)",
        "hopper medium-replay, 50 % random",
    ]


def test_suites_played_differently_are_not_one_suite(tmp_path):
    top = fakes.write_experiment(tmp_path)
    assert comparison_notes(fakes.read_all(top)) == []
    path = top / "hopper" / "osr" / "seed1" / "robustness-hand.json"
    content = json.loads(path.read_text())
    earlier, last = content["evaluations"]
    fakes.write_json(path, content | {"evaluations": [last]})
    renamed = path.with_name("robustness-renamed.json")
    fakes.write_json(renamed, content | {"evaluations": [earlier]})
    tables = fakes.read_all(top)
    assert [name.partition(", seeds")[0] for name in tables.suites] == [
        "hand (checkpoints=last 2", "hand (checkpoints=last 1", "renamed-at-7000"
    ]  # fmt: skip
