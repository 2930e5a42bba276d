"""A run under disturbances: what is played, kept, continued and refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import evaluating, options, trained

from torchrl_osr.lab.dynamics import SwitchingPolicy
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.run.config import read_run, write_config
from torchrl_osr.lab.run.evaluate import UnitActions, evaluate_run, make_disturbances
from torchrl_osr.lab.run.load import CHECKPOINTS, load_trained


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run with three checkpoints."""
    more = "trainer.steps=30", "trainer.eval_interval=30"
    return trained(tmp_path_factory.mktemp("evaluate") / "run", *more)


def play(checkpoint: Path, *overrides: str) -> dict:
    config = evaluating(f"checkpoint={checkpoint}", "episodes=2", *overrides)
    path, results = evaluate_run(config)
    assert json.loads(path.read_text()) == json.loads(json.dumps(results))
    return results


def test_a_switching_policy_is_played_from_minus_1_to_1():
    forces = SwitchingPolicy([lambda s: 8 * s - 2], None, lambda s, a: a[:, 0])
    policy = UnitActions(forces, torch.tensor([[-2.0], [6.0]]))
    assert policy(torch.tensor([[0.0], [0.5]])).tolist() == [[-1], [0]]


def test_results_are_kept_with_what_decides_them(folder, capsys, monkeypatch):
    given = folder, "suite=start", "last=2"
    monkeypatch.setattr("os.access", lambda path, mode: path != folder)
    with pytest.raises(PermissionError, match="is read-only: work on a copy of it"):
        play(*given)
    monkeypatch.undo()
    results = play(*given)
    names = list(evaluating("suite=start").suite.disturbances)
    assert (results["env"], results["data"]) == ("hopper", "random")
    assert {"torchrl_osr", "torch", "mujoco"} < results["versions"].keys()
    assert [each["step"] for each in results["evaluations"]] == [20, 30]
    seeds = [each["clean"]["seeds"] for each in results["evaluations"]]
    assert seeds == [[20_000, 20_001], [21_000, 21_001]]
    for each in results["evaluations"]:
        assert [level["name"] for level in each["levels"]] == names
        for level in each["levels"]:
            assert level["seeds"] == each["clean"]["seeds"]
            assert len(level["returns"]) == len(level["scores"]) == 2
    # Not played again, unless forced; never replaced by other settings.
    assert play(*given) == results
    assert "is there already" in capsys.readouterr().out
    assert play(*given, "force=true") == results
    for change, named in {"seed=5": "seed", "last=1": "checkpoints"}.items():
        with pytest.raises(ValueError, match=f"results of other {named}: force=true"):
            play(*given, change)
    other = play(*given, "seed=5", "force=true")
    assert other["evaluations"] != results["evaluations"]


def test_every_suite_is_built():
    for name in options("evaluation/suite"):
        suite = evaluating(f"suite={name}").suite
        assert suite.name == name
        made = make_disturbances(suite.disturbances, np.full(11, 0.5))
        assert len(made) >= 3 or suite.half


def test_recoverable_states_are_played_from(folder):
    best = folder / CHECKPOINTS / "best.torchrl"
    results = play(best, "suite=recoverable")
    states, trained = load_recoverable_states("hopper", "public"), load_trained(best)
    policy = deterministic_policy(trained.actor, trained.observation_norm)
    back = recovers(states, policy)
    assert results["evaluations"][-1]["back"] == back.astype(int).tolist()
    assert (folder / "best-recoverable-public.json").exists()
    # Fallen at once, as anything is that has learned nothing.
    assert not back[states.group == "recoverable"].any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "cart"}, "recoverable states must be one of .*, got 'cart'"),
        ({"action_high": [2.0, 2.0, 2.0]}, "action_high=.*, but Hopper-v5 has"),
        ({"id": "json:Hopper-v5"}, r"allow it with trust=\[json\]"),
    ],
)
def test_a_run_of_another_task_is_refused(folder, tmp_path, changes, message):
    config = read_run(folder)
    for name, value in changes.items():
        setattr(config.env, name, value)
    write_config(tmp_path, config)
    (tmp_path / "checkpoint").symlink_to(folder / "checkpoint")
    with pytest.raises(ValueError, match=message):
        play(tmp_path, "suite=recoverable")
