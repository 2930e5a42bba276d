"""A sweep, stopped by a signal and started again, in processes of its own."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

SCRIPT = "train"


@pytest.fixture(scope="module")
def sizes(tiny) -> list[str]:
    return tiny(
        inverse_dynamics_steps=30, steps=200, eval_interval=200, checkpoint_interval=50,
        record="false",
    )  # fmt: skip


def stop_in_policy_phase(
    process: subprocess.Popen, cwd: Path, number: int = signal.SIGTERM
) -> tuple[int, str]:
    """Send a signal somewhere in the second phase of the run in a folder's folder."""
    pattern = "*/checkpoint/policy/checkpoint-000000000050.torchrl"
    while not list(cwd.glob(pattern)):
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.001)
    time.sleep(random.uniform(0.0, 0.1))
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    return process.returncode, output


def status(folder: Path) -> str:
    return json.loads((folder / "status.json").read_text())["status"]


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
