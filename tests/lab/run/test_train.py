"""A short run in this process: its files, its loggers, its exported policies."""

from __future__ import annotations

import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from composed import trained
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_osr import load_policy
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.evaluation.figures import read_scalars
from torchrl_osr.lab.run.load import CHECKPOINTS, load_trained

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, own_cache):
    top = tmp_path_factory.mktemp("train")
    intervals = "trainer.eval_interval=5", "trainer.checkpoint_interval=5"
    return trained(top / "run", *intervals, "logger=tensorboard")


def test_the_last_and_the_best_policy_are_exported(folder):
    best = json.loads((folder / "returns.json").read_text())["best"]["step"]
    files = {
        folder / "policy.safetensors": (folder, 10),
        folder / CHECKPOINTS / "best.safetensors": (
            folder / CHECKPOINTS / "best.torchrl",
            best,
        ),
    }
    state = np.random.default_rng(0).normal(size=(5, 11)).astype(np.float32)
    for file, (source, step) in files.items():
        policy, run = load_policy(file), load_trained(source)
        assert policy.record["source"]["step"] == run.step == step
        there = deterministic_policy(run.actor, run.observation_norm)
        np.testing.assert_allclose(
            policy.act(state), there(torch.as_tensor(state)).numpy(), atol=1e-6
        )


def test_tensorboard_has_the_numbers_of_the_csv_files(folder):
    scalars = read_scalars(folder / "csv" / "scalars" / "policy")
    assert {"score", "loss_qvalue", "recovery_kl"} < scalars.keys()
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    found = {each.step: each.value for each in events.Scalars("policy/score")}
    assert found == pytest.approx(dict(scalars["score"]))


def test_r2_of_a_constant_action_is_null_in_the_file_and_a_dash(tmp_path, capsys):
    rng = np.random.default_rng(0)
    np.savez(
        tmp_path / "log.npz",
        observation=rng.normal(size=(600, 11)),
        action=rng.uniform(-0.9, 0.9, (600, 3)) * [1, 0, 1],
        reward=rng.normal(size=600),
        terminated=np.zeros(600, bool),
        truncated=np.arange(600) % 50 == 49,
    )
    folder = trained(tmp_path / "run", "data=file", f"data.path={tmp_path}/log.npz")
    results = json.loads((folder / "inverse_dynamics.json").read_text())
    assert results["r2"][1] is None
    assert re.search(r"R2 -?\d\.\d\d, -, -?\d\.\d\d\n", capsys.readouterr().out)


class FakeRun:
    """Stands for ``wandb.Run``; keeps what it is given."""

    def __init__(self, **options):
        self.options, self.logged, self.finished = options, {}, False
        self.config = {}

    def define_metric(self, *names, **options): ...

    def log(self, values, **options):
        self.logged |= values

    def finish(self):
        self.finished = True


def test_wandb_gets_the_run_its_curve_and_its_results(tmp_path, monkeypatch):
    runs = []

    def init(**options):
        runs.append(FakeRun(**options))
        return runs[-1]

    fake = SimpleNamespace(init=init, Image=lambda path: path)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr("torchrl.record.loggers.wandb._has_wandb", True)
    # It is handed what update() of a real configuration takes besides.
    monkeypatch.setattr("torchrl.record.loggers.wandb._collect_env_metadata", dict)
    given = ["loss=rebrac", "recovery=osr", "logger=wandb", "logger.project=mine"]
    given += ["data.storage=disk"]
    folder = trained(tmp_path / "run", *given)
    trained(folder, *given, "trainer.steps=12")
    first, second = runs
    assert first.options["name"] == "hopper-random rebrac+osr seed0"
    assert first.options["config"]["loss"]["_target_"].endswith("ReBRACLoss")
    assert (first.options["project"], first.options["mode"]) == ("mine", "offline")
    assert first.logged["curve"] == str(folder / "curve.png")
    assert "policy/score" in first.logged
    assert first.finished
    assert first.options["id"] == second.options["id"], "a continued run is the same"


def test_a_missing_logger_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ImportError, match=r"logger=wandb needs .*torchrl-osr\[wandb\]"):
        trained(tmp_path / "run", "logger=wandb")
