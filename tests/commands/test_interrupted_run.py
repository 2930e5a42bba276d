"""The main example, stopped by a signal and started again, in processes of its own."""

from __future__ import annotations

import io
import json
import random
import signal
import subprocess
import time
import zipfile
from pathlib import Path

import pytest
import torch
from torch.utils._pytree import tree_leaves

SCRIPT = "train"


@pytest.fixture(scope="module")
def sizes(tiny) -> list[str]:
    return tiny(
        inverse_dynamics_steps=30, steps=300, eval_interval=150, checkpoint_interval=50
    )


def stop_in_policy_phase(
    process: subprocess.Popen, cwd: Path, number: int = signal.SIGTERM
) -> tuple[int, str]:
    """Send a signal somewhere in the second phase of the run in a folder's folder."""
    pattern = "*/checkpoint/policy/checkpoint-000000000050.torchrl"
    while not list(cwd.glob(pattern)):
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.001)
    time.sleep(random.uniform(0.0, 0.3))
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    return process.returncode, output


def status(folder: Path) -> str:
    return json.loads((folder / "status.json").read_text())["status"]


def tensors(folder: Path) -> list[torch.Tensor]:
    """All tensors of the last checkpoint, but for the process's generators."""
    found = []
    path = folder / "checkpoint/policy/checkpoint-000000000300.torchrl"
    with zipfile.ZipFile(path) as archive:
        for name in sorted(archive.namelist()):
            if name.endswith("state.pt") and "global_rng" not in name:
                content = io.BytesIO(archive.read(name))
                state = torch.load(content, weights_only=True)
                found += filter(torch.is_tensor, tree_leaves(state))
    return found


def test_stopped_run_goes_on_to_the_same_bits(tmp_path, start, run, sizes):
    code, output = run(tmp_path, SCRIPT, *sizes, "hydra.run.dir=undisturbed")
    assert code == 0, output
    (tmp_path / "here").mkdir()
    folder = tmp_path / "here" / "run"
    process = start(tmp_path, SCRIPT, *sizes, "hydra.run.dir=here/run")
    code, output = stop_in_policy_phase(process, tmp_path / "here", signal.SIGINT)
    assert code == 130, output
    assert "stopped by SIGINT at step" in output
    assert f"Continue with: torchrl-osr train resume={folder}\n" in output
    assert status(folder) == "preempted"
    began = {path: path.read_text() for path in (folder / ".hydra").iterdir()}
    code, output = run(tmp_path, SCRIPT, f"resume={folder}")
    assert code == 0, output
    assert status(folder) == "done"
    assert all(path.read_text() == text for path, text in began.items())
    mine, theirs = tensors(folder), tensors(tmp_path / "undisturbed")
    assert len(mine) > 20
    assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))
    returns = (folder / "returns.json").read_text()
    assert returns == (tmp_path / "undisturbed" / "returns.json").read_text()


def test_second_sweep_continues_what_is_not_done(tmp_path, start, run, sizes):
    arguments = ["-m", *sizes, "loss=cql", "seed=0,1", "hydra.sweep.dir=sweep"]
    process = start(tmp_path, SCRIPT, *arguments)
    code, output = stop_in_policy_phase(process, tmp_path / "sweep")
    assert code == 75, output
    (folder,) = (each for each in (tmp_path / "sweep").iterdir() if each.is_dir())
    assert status(folder) == "preempted"
    code, output = run(tmp_path, SCRIPT, *arguments)
    assert code == 0, output
    pattern = "sweep/*/checkpoint/policy/checkpoint-*"
    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob(pattern)}
    assert len(list(tmp_path.glob("sweep/*/returns.json"))) == 2
    # And once more, when all is done: nothing is trained.
    code, output = run(tmp_path, SCRIPT, *arguments)
    assert code == 0, output
    again = {path: path.stat().st_mtime_ns for path in tmp_path.glob(pattern)}
    assert again == written
    for path in tmp_path.glob("sweep/*/status.json"):
        assert status(path.parent) == "done"
