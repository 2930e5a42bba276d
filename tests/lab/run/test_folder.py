"""A run's folder: never two configurations in one, never half a file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
from composed import composed, job
from omegaconf import OmegaConf

from torchrl_osr.lab.run.config import write_config
from torchrl_osr.lab.run.folder import open_run, read_status
from torchrl_osr.trainers import Interrupted


def opened(folder, *overrides):
    return open_run(composed("train", *overrides), folder, job(*overrides))


def claim(folder, *overrides) -> dict:
    with opened(folder, *overrides) as run:
        write_config(run.folder, run.config)  # as a training that has its data
    return written(folder)


def written(folder) -> dict:
    return OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))


def status(folder) -> dict:
    return json.loads((folder / "status.json").read_text())


def test_a_new_run_is_named_checked_and_done(tmp_path):
    folder = tmp_path / "run"
    with opened(folder, "loss=cql", "recovery=none", "seed=3") as run:
        assert status(folder)["status"] == "running"
        assert (run.method, run.folder) == ("cql", folder)
        assert run.config.env.observation_size == 11
        assert run.config.env.action_high == [1.0, 1.0, 1.0]
    assert status(folder) == {"status": "done"}
    config = written(folder)
    assert config["seed"] == 3
    assert config.keys().isdisjoint({"resume", "force", "trust", "settings"})
    assert claim(folder, f"resume={folder}") == config


def test_some_settings_may_differ_and_steps_may_grow(tmp_path):
    claim(tmp_path)
    more = ["trainer.steps=40_000", "logger=wandb", "trainer.progress=false"]
    assert claim(tmp_path, *more)["trainer"]["steps"] == 40_000
    resume = f"resume={tmp_path}"
    config = claim(tmp_path, resume, "trainer.steps=50_000")
    assert (config["trainer"]["steps"], config["logger"]["kind"]) == (50_000, "wandb")
    with pytest.raises(ValueError, match="trainer.steps=50000, and 4 are fewer"):
        claim(tmp_path, resume, "trainer.steps=4", "force=true")
    claim(falling := tmp_path / "falling", "loss=iql")
    named = r"settings \(trainer.steps: \d+ there, 50000 "
    with pytest.raises(ValueError, match=named):
        claim(falling, "loss=iql", "trainer.steps=50_000")


@pytest.mark.parametrize("resumed", [False, True])
def test_other_settings_are_refused_by_key_unless_forced(tmp_path, caplog, resumed):
    config, resume = claim(tmp_path), [f"resume={tmp_path}"] * resumed
    for override, message in {
        "seed=1": r"holds a run.*\(seed: 0 there, 1 now\)",
        "trainer.batch_size=0": "trainer.batch_size must be at least 1",
        **({"preset=paper": "preset=paper is none of its"} if resumed else {}),
    }.items():
        with pytest.raises(ValueError, match=message):
            claim(tmp_path, *resume, override)
        assert (written(tmp_path), status(tmp_path)) == (config, {"status": "done"})
    assert claim(tmp_path, *resume, "seed=1", "force=true")["seed"] == 1
    assert "by force=true: seed: 0 there, 1 now" in caplog.text


def test_a_foreign_run_imports_no_environment_of_its_own(tmp_path):
    config = claim(tmp_path)
    config["env"]["id"] = "antigravity:Hopper-v5"
    OmegaConf.save(config, tmp_path / "config.yaml")
    with pytest.raises(ValueError, match=r"allow it with trust=\[antigravity\]"):
        claim(tmp_path, f"resume={tmp_path}")
    assert "antigravity" not in sys.modules


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
        with pytest.raises(ValueError, match="another process is training in"):
            claim(tmp_path)
        found = status(tmp_path)
        assert found["pid"] == holder.pid, "left as it was"
        assert read_status(tmp_path) == found
        holder.kill()
    # A lock does not outlive its process.
    assert read_status(tmp_path)["status"] == "killed"
    claim(tmp_path)


def test_a_process_of_another_machine_may_still_run(tmp_path):
    found = {"status": "running", "pid": os.getpid(), "host": "elsewhere"}
    (tmp_path / "status.json").write_text(json.dumps(found))
    assert read_status(tmp_path) == found
    assert [path.name for path in tmp_path.iterdir()] == ["status.json"]


@pytest.mark.parametrize(("name", "code"), [("TERM", 75), ("HUP", 75), ("INT", 130)])
def test_a_signal_outside_of_training_ends_a_run_in_order(tmp_path, caplog, name, code):
    def stop():
        os.kill(os.getpid(), signal.Signals[f"SIG{name}"])
        pytest.fail("not reached")

    folder = tmp_path / "a run"
    with pytest.raises(Interrupted) as raised, opened(folder):
        stop()
    assert raised.value.code == code
    assert status(folder)["status"] == "preempted"
    assert f"stopped by SIG{name}" in status(folder)["reason"]
    assert f"Continue with: torchrl-osr train 'resume={folder}'" in caplog.text
