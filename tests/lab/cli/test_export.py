"""The command writes a file and says how far it is from the policy."""

from __future__ import annotations

import pytest
from untrained_run import make_run

from torchrl_osr.lab.cli import export
from torchrl_osr.lab.run.load import load_run_policy


def test_from_a_run_to_each_kind_of_file(tmp_path, run):
    make_run(tmp_path / "run")
    for arguments in [
        ("run", "p.safetensors"),
        ("p.safetensors", "p.pt2"),
        ("run/checkpoint/policy/best.torchrl", "v.pt2", "--output", "value"),
    ]:
        code, output = run(tmp_path, "export", *arguments)
        assert code == 0, output
        step = 10 if "best" in arguments[0] else 900
        assert f"OSRLoss, Hopper-v5, step {step}\n" in output
        assert float(output.rpartition(" ")[2]) <= 1e-6


def test_a_file_that_deviates_is_reported(tmp_path):
    make_run(tmp_path / "run")
    policy, path = load_run_policy(tmp_path / "run"), tmp_path / "p.safetensors"
    policy.save(path)
    assert export.check(policy, path, "action") == 0
    policy.actor[-1].bias += 0.1
    with pytest.raises(ValueError, match="was written, but deviates from the policy"):
        export.check(policy, path, "action")


def test_what_cannot_be_exported_is_one_line(tmp_path, run):
    for arguments, message in [
        (["nowhere", "p.onnx"], "there is no run and no checkpoint at nowhere."),
        (["nowhere", "p.pt"], "must end in .safetensors, .onnx or .pt2.\n"),
    ]:
        code, output = run(tmp_path, "export", *arguments)
        assert code != 0
        assert message in output
        assert "Traceback" not in output
