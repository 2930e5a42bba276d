"""A short run in this process: its files, its loggers, its exported policies."""

from __future__ import annotations

import json
import re
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from composed import trained
from recorded_logs import make_columns, save
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.checkpoint import CheckpointError

from torchrl_osr import load_policy
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.evaluation.figures import read_scalars
from torchrl_osr.lab.run.load import CHECKPOINTS, load_trained


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    top = tmp_path_factory.mktemp("train")
    intervals = "trainer.eval_interval=5", "trainer.checkpoint_interval=5"
    return trained(top / "run", *intervals, "logger=tensorboard")


def test_the_last_and_the_best_policy_are_exported(folder):
    step_of_best = json.loads((folder / "returns.json").read_text())["best"]["step"]
    best = folder / CHECKPOINTS / "best"
    state = np.random.default_rng(0).normal(size=(5, 11)).astype(np.float32)
    for file, checkpoint, step in [
        (folder / "policy", folder, 10),
        (best, best.with_suffix(".torchrl"), step_of_best),
    ]:
        policy = load_policy(file.with_suffix(".safetensors"))
        run = load_trained(checkpoint)
        assert policy.record["source"]["step"] == run.step == step
        there = deterministic_policy(run.actor, run.observation_norm)
        wanted = there(torch.as_tensor(state)).numpy()
        np.testing.assert_allclose(policy.act(state), wanted, atol=1e-6)


def test_forced_settings_that_do_not_fit_leave_a_run_as_it_was(tmp_path):
    folder = trained(tmp_path / "run")
    names = "config.yaml", "policy.safetensors", "status.json"
    before = [(folder / name).read_bytes() for name in names]
    with pytest.raises(CheckpointError, match="does not fit this run"):
        trained(folder, "network.num_cells=[5]", "trainer.steps=12", "force=true")
    assert [(folder / name).read_bytes() for name in names] == before


def test_tensorboard_has_the_numbers_of_the_csv_files(folder):
    scalars = read_scalars(folder / "csv" / "scalars" / "policy")
    assert {"score", "loss_qvalue", "recovery_kl"} < scalars.keys()
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    found = {each.step: each.value for each in events.Scalars("policy/score")}
    assert found == pytest.approx(dict(scalars["score"]))


def test_r2_of_a_constant_action_is_null_in_the_file_and_a_dash(tmp_path, capsys):
    rng, columns = np.random.default_rng(0), make_columns(600)
    columns["observation"] = rng.normal(size=(600, 11))
    columns["action"] = rng.uniform(-0.9, 0.9, (600, 3)) * [1, 0, 1]
    log = save(tmp_path / "log.npz", columns)
    folder = trained(tmp_path / "run", "data=file", f"data.path={log}")
    results = json.loads((folder / "inverse_dynamics.json").read_text())
    assert results["r2"][1] is None
    assert re.search(r"R2 -?\d\.\d\d, -, -?\d\.\d\d\n", capsys.readouterr().out)


def test_wandb_gets_the_run_its_curve_and_its_results(tmp_path, monkeypatch):
    fake = MagicMock(Image=str)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr("torchrl.record.loggers.wandb._has_wandb", True)
    given = ["loss=rebrac", "recovery=osr", "logger=wandb", "logger.project=mine"]
    folder = trained(tmp_path / "run", *given)
    trained(folder, *given, "trainer.steps=12")
    first, second = (call.kwargs for call in fake.init.call_args_list)
    assert first["name"] == "hopper-random rebrac+osr seed0"
    assert first["config"]["loss"]["_target_"].endswith("ReBRACLoss")
    assert (first["project"], first["mode"]) == ("mine", "offline")
    assert first["id"] == second["id"], "a continued run is the same"
    run, logged = fake.init.return_value, {}
    for call in run.log.call_args_list:
        logged |= call.args[0]
    assert logged["curve"] == str(folder / "curve.png")
    assert "policy/score" in logged
    assert run.finish.call_count == 2
    assert not run.config.update.called, "TorchRL would replace the configuration's env"
