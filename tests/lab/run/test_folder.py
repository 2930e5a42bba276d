"""A run's folder: never two configurations in one, never half a file."""

from __future__ import annotations

import json
import os
import platform
import shlex
import signal
import subprocess
import sys

import pytest
from composed import composed, job
from omegaconf import OmegaConf
from torchrl.checkpoint import CheckpointError

from torchrl_osr.lab.run.folder import open_run, read_status
from torchrl_osr.trainers import Interrupted


def opened(folder, *overrides):
    return open_run(composed("train", *overrides), folder, job(*overrides))


def claim(folder, *overrides) -> dict:
    with opened(folder, *overrides):
        pass
    return written(folder)


def written(folder) -> dict:
    return OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))


def status(folder) -> dict:
    return json.loads((folder / "status.json").read_text())


def resume(folder, *overrides):
    return claim(folder, f"resume={folder}", *overrides)


def test_a_new_run_is_named_checked_and_done(tmp_path):
    folder = tmp_path / "run"
    with opened(folder, "loss=cql", "recovery=none", "seed=3") as run:
        assert status(folder)["status"] == "running"
        assert (run.method, run.folder, run.simulated) == ("cql", folder, True)
        assert run.config.env.observation_size == 11
        assert run.config.env.action_high == [1.0, 1.0, 1.0]
    assert status(folder) == {"status": "done"}
    config = written(folder)
    assert config["seed"] == 3
    assert config.keys().isdisjoint({"resume", "force", "trust", "settings"})
    assert resume(folder) == config


def test_some_settings_may_differ_and_steps_may_grow(tmp_path):
    claim(tmp_path)
    more = ["trainer.steps=40_000", "logger=wandb", "trainer.progress=false"]
    config = claim(tmp_path, *more)
    assert config["trainer"]["steps"] == 40_000
    assert resume(tmp_path, "trainer.steps=50_000")["trainer"]["steps"] == 50_000
    with pytest.raises(ValueError, match="trainer.steps=50000, and 4 are fewer"):
        resume(tmp_path, "trainer.steps=4", "force=true")


def test_other_settings_are_refused_by_key_unless_forced(tmp_path, caplog):
    config, before = claim(tmp_path), status(tmp_path)
    for refused in (claim, resume):
        with pytest.raises(ValueError, match=r"holds a run.*\(seed: 0 there, 1 now\)"):
            refused(tmp_path, "seed=1")
        assert (written(tmp_path), status(tmp_path)) == (config, before)
    assert resume(tmp_path, "seed=1", "force=true")["seed"] == 1
    assert "by force=true: seed: 0 there, 1 now" in caplog.text


def test_a_run_whose_checkpoints_do_not_fit_is_what_it_was(tmp_path):
    config = claim(tmp_path)
    with pytest.raises(CheckpointError), opened(tmp_path, "seed=1", "force=true"):
        raise CheckpointError("5 tensors differ")
    assert (written(tmp_path), status(tmp_path)) == (config, {"status": "done"})


def test_overrides_that_are_no_settings_are_refused(tmp_path):
    claim(tmp_path)
    with pytest.raises(ValueError, match="preset=paper is none of its settings"):
        resume(tmp_path, "preset=paper")


def test_a_refused_run_says_why_and_an_old_one_stays(tmp_path):
    with pytest.raises(ValueError, match="trainer.steps must be at least 1"):
        claim(tmp_path / "new", "trainer.steps=0")
    assert "trainer.steps must be" in status(tmp_path / "new")["error"]
    claim(tmp_path / "old")
    with pytest.raises(ValueError, match="trainer.steps must be at least 1"):
        claim(tmp_path / "old", "trainer.steps=0")
    assert status(tmp_path / "old") == {"status": "done"}


@pytest.mark.parametrize("error", [ValueError("why"), KeyboardInterrupt("why")])
def test_status_says_failed_and_why(tmp_path, error):
    with pytest.raises(type(error)), opened(tmp_path):
        raise error
    reason = f"{type(error).__name__}: why"
    assert status(tmp_path) == {"status": "failed", "error": reason}


HOLDER = """
import sys
from pathlib import Path
from composed import composed, job
from torchrl_osr.lab.run.folder import open_run
with open_run(composed("train"), Path(sys.argv[1]), job()):
    print("training", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_in_the_folder_is_refused(tmp_path):
    arguments = [sys.executable, "-c", HOLDER, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(arguments, env=environment, **pipes) as holder:
        assert holder.stdout.readline() == "training\n"
        process = f"process {holder.pid} on {platform.node()}"
        with pytest.raises(ValueError, match=f"{process} is training in"):
            claim(tmp_path)
        found = status(tmp_path)
        assert found["pid"] == holder.pid, "left as it was"
        assert read_status(tmp_path) == found
        holder.kill()
    # A lock does not outlive its process.
    killed = found | {"status": "killed", "reason": f"{process} is gone"}
    assert read_status(tmp_path) == killed
    claim(tmp_path)


def test_a_process_of_another_machine_may_still_run(tmp_path):
    found = {"status": "running", "pid": os.getpid(), "host": "elsewhere"}
    (tmp_path / "status.json").write_text(json.dumps(found))
    assert read_status(tmp_path) == found
    assert [path.name for path in tmp_path.iterdir()] == ["status.json"]


@pytest.mark.parametrize("made_anew", [False, True])
def test_a_folder_that_is_gone_at_the_end_is_no_success(tmp_path, made_anew):
    folder, other = tmp_path / "run", {"status": "running", "pid": 1, "host": "x"}

    def move():
        folder.rename(tmp_path / "elsewhere")
        if made_anew:
            folder.mkdir()
            (folder / "status.json").write_text(json.dumps(other))

    with pytest.raises(FileNotFoundError, match="removed or renamed"), opened(folder):
        move()
    assert status(folder) == other if made_anew else not folder.exists()


@pytest.mark.parametrize(("name", "code"), [("TERM", 75), ("HUP", 75), ("INT", 130)])
def test_a_signal_outside_of_the_training_ends_the_run_in_order(
    tmp_path, caplog, name, code
):
    def stop():
        os.kill(os.getpid(), signal.Signals[f"SIG{name}"])
        pytest.fail("not reached")

    with pytest.raises(Interrupted) as raised, opened(tmp_path):
        stop()
    assert raised.value.code == code
    assert status(tmp_path)["status"] == "preempted"
    assert f"stopped by SIG{name}" in status(tmp_path)["reason"]


def test_a_preempted_run_logs_the_command_that_continues_it(tmp_path, caplog):
    folder, trust = tmp_path / "0_loss=cql,seed=1", "trust=[json,tabnanny]"
    with pytest.raises(Interrupted), opened(folder, trust):
        raise Interrupted("saved at step 3", 75)
    assert status(folder) == {"status": "preempted", "reason": "saved at step 3"}
    *_, line = caplog.text.strip().splitlines()
    _, command = line.split("Continue with: ")
    # Quoted for Hydra, and then for the shell.
    assert shlex.split(command)[2:] == [f"resume='{folder}'", trust]
