"""The command writes a file and says how far it is from the policy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from recorded_logs import make_columns, save
from untrained_run import make_run

from torchrl_osr import CQLLoss, load_policy, modules
from torchrl_osr.lab.cli import export
from torchrl_osr.lab.run.load import load_run_policy
from torchrl_osr.policy import fit_monitor, policy_from_loss


def test_from_a_run_to_each_kind_of_file(tmp_path, run):
    make_run(tmp_path / "run")
    for arguments in [
        ("run", "p.safetensors"),
        ("p.safetensors", "{p}.pt2"),
        ("run/checkpoint/policy/best.torchrl", "new/v.pt2", "--output", "value"),
    ]:
        output = run(tmp_path, "export", *arguments)
        step = 10 if "best" in arguments[0] else 900
        assert f"OSRLoss, Hopper-v5, step {step}, without a monitor\n" in output
        assert float(output.rpartition(" ")[2]) <= 1e-6


def test_a_monitor_of_the_runs_data(tmp_path, run):
    """Rows before a fall are far from the others: they are the only alarms."""
    columns = make_columns(4000)
    rows = np.random.default_rng(0).normal(size=(4000, 11)).astype(np.float32)
    fell = columns["terminated"].reshape(100, 40)[:, -1]
    late = np.zeros((100, 40), bool)
    late[fell, -5:] = True
    rows[late.ravel()] += 9
    columns |= {"observation": rows, "action": rows[:, :3].clip(-1, 1)}
    save(tmp_path / "log.npz", columns)
    save(tmp_path / "own.npz", columns | {"observation": rows * 2})
    make_run(tmp_path / "run", "data=file", f"data.path={tmp_path}/old.npz")
    given = ["data.path=log.npz", "monitor.false_alarms=0.1", "monitor.fall_steps=5"]
    output = run(tmp_path, "export", "run", "m.safetensors", *given)
    assert "in at most 0.1 of episodes like the 50 held-out episodes" in output
    assert f"{5 * fell.sum()} rows in the 5 steps before a terminal state" in output
    alarm = load_policy(tmp_path / "m.safetensors").monitor(rows)[1].reshape(100, 40)
    assert alarm[late].all()
    assert np.where(late, False, alarm).any(1).mean() <= 0.1
    given += ["monitor.episodes=own.npz", "monitor.false_alarms=0.01"]
    output = run(tmp_path, "export", "run", "m.pt2", *given)
    assert "100 episodes of own.npz" in output


def test_scores_of_one_sensor_round_and_are_no_deviation(tmp_path):
    loss = CQLLoss(modules.tanh_gaussian_actor(1, 1), modules.critic_ensemble(1, 1))
    policy, rows = policy_from_loss(loss), torch.randn(400, 1)
    policy.attach(fit_monitor(rows, torch.arange(400) // 10))
    policy.export(tmp_path / "p.onnx")
    assert export.check(policy, tmp_path / "p.onnx", "action") < 1e-5


def test_a_file_that_deviates_is_reported(tmp_path):
    make_run(tmp_path / "run")
    policy, path = load_run_policy(tmp_path / "run"), tmp_path / "p.safetensors"
    policy.save(path)
    assert export.check(policy, path, "action") == 0
    for change in (0.1, np.nan):
        policy.actor[-1].bias += change
        with pytest.raises(ValueError, match="written, but deviates from the policy"):
            export.check(policy, path, "action")


def test_what_cannot_be_exported_is_one_line(tmp_path, run):
    make_run(tmp_path / "r")
    for code, arguments, message in [
        (1, "nowhere p.onnx", "there is no run and no checkpoint at nowhere."),
        (1, "r p.pt2 monitor.rate=1", "there is no key 'monitor.rate'; its"),
        (2, "r p.pt2 monitor.fall_steps=1 --output value", "leave out --output value"),
        (2, "nowhere p.pt", "must end in .safetensors, .onnx or .pt2.\n"),
    ]:
        output = run(tmp_path, "export", *arguments.split(), code=code)
        assert message in output
        assert "Traceback" not in output
