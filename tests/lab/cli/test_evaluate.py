"""The command line of an evaluation: one run, a sweep, a sweep as one policy."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from composed import composed, trained

from torchrl_osr.lab.cli.evaluate import main
from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.dynamics.training import MODEL, write_dynamics
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.run.load import load_switching_policy


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run with two checkpoints."""
    more = "trainer.steps=20", "trainer.eval_interval=20"
    return trained(tmp_path_factory.mktemp("evaluate") / "run", *more)


def evaluate(*overrides: str) -> None:
    main(composed("evaluate", "progress=false", "episodes=2", *overrides))


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["episodes=1"], "episodes at least 2"),
        (["sweep=runs"], "either checkpoint=.* or sweep="),
        (["switching=true"], "switching=true needs sweep="),
        (["checkpoint=null", "sweep=."], "no finished run in or below"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, folder, overrides, named):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, OSError), match=named):
        evaluate(f"checkpoint={folder}", *overrides)


def test_sweep_evaluates_every_finished_run(tmp_path, folder, run):
    for name in ("0_good", "1_damaged", "2_running", "3_copied"):
        shutil.copytree(folder, tmp_path / "sweep" / name)
    sweep = tmp_path / "sweep"
    (sweep / "3_copied" / "status.json").unlink()
    (sweep / "2_running" / "status.json").write_text('{"status": "running"}')
    for path in (sweep / "1_damaged" / "checkpoint" / "policy").glob("checkpoint-*"):
        path.write_bytes(path.read_bytes()[:100])
    options = ["sweep=sweep", "jobs=2", "suite=start", "episodes=2", "last=1"]
    output = run(tmp_path, "evaluate", *options, code=1)
    lines = output.splitlines()
    assert lines[0] == "left out: sweep/2_running: not finished, its status is running"
    assert lines[1] == "left out: sweep/3_copied: not finished, its status is unknown"
    assert lines[-1] == "1 of 2 runs failed: sweep/1_damaged."
    assert re.search(r"of 2: sweep/1_damaged: failed: \S+ is damaged: ", output)
    assert "sweep/0_good: sweep/0_good/robustness-start.json" in output
    assert (sweep / "0_good" / "robustness-start.json").exists()


def test_recovery_rates_are_printed_by_group(folder, capsys):
    evaluate(f"checkpoint={folder}", "suite=recoverable")
    printed = capsys.readouterr().out
    assert re.search(r"(?m)^  easy % +\d+\.\d \[\d+\.\d, \d+\.\d\]$", printed)


def test_runs_of_a_sweep_are_one_policy_that_switches(folder, tmp_path, capsys):
    runs = [tmp_path / name for name in ("a/run", "b/run")]
    for run in runs:
        shutil.copytree(folder, run)
        torch.manual_seed(len(run.parts))
        model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=1, num_cells=[4])
        write_dynamics(run / MODEL, model)
    for file in (runs[1] / "checkpoint" / "policy").glob("checkpoint-*20.torchrl"):
        file.unlink()  # so that they differ: its last step is 10
    sweep = [f"sweep={tmp_path}", "switching=true"]
    evaluate(*sweep, "suite=recoverable")
    results = json.loads((tmp_path / "switching-recoverable-public.json").read_text())
    last = "checkpoint/policy/checkpoint-0000000000"
    assert list(results["checkpoints"]) == [
        f"a/run/{last}20.torchrl", f"b/run/{last}10.torchrl"
    ]  # fmt: skip
    states = load_recoverable_states("hopper", "public")
    back = recovers(states, load_switching_policy(runs))
    assert results["evaluations"][0]["back"] == back.astype(int).tolist()
    printed = capsys.readouterr().out
    assert "hopper random, public recoverable states, each played 1 x\n" in printed
    evaluate(*sweep, "suite=official")
    results = json.loads((tmp_path / "switching-robustness-official.json").read_text())
    assert len(results["evaluations"]) == 1
