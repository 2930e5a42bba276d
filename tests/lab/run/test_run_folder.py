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
from omegaconf import OmegaConf
from torchrl.checkpoint import CheckpointError

from torchrl_osr.lab.run import run_folder
from torchrl_osr.trainers import Interrupted

CONFIG = {
    "seed": 0,
    "resume": None,
    "force": False,
    "trust": [],
    "logger": {"kind": "csv"},
    "trainer": {"steps": 5, "progress": True},
}
JOB = OmegaConf.create({"overrides": {"task": ["seed=0"]}})


def configured(**changes):
    return OmegaConf.merge(OmegaConf.create(CONFIG), changes)


def claim(folder, **changes):
    folder.mkdir(parents=True, exist_ok=True)
    with run_folder.claimed(folder, configured(**changes), JOB):
        pass


def resumed(folder, *overrides):
    composed = configured(**OmegaConf.from_dotlist(list(overrides)))
    return run_folder.resumed(folder, composed, [f"resume={folder}", *overrides])


def test_configuration_is_written_and_read_back(tmp_path):
    claim(tmp_path / "run", resume="x", force=True)
    assert OmegaConf.load(tmp_path / "run" / "config.yaml") == CONFIG
    assert resumed(tmp_path / "run") == CONFIG
    job = OmegaConf.load(tmp_path / "run" / ".hydra" / "hydra.yaml")
    assert job == {"hydra": JOB}


@pytest.mark.parametrize(
    "changes",
    [{}, {"trainer": {"progress": False}}, {"trainer": {"steps": 6}},
     {"logger": {"kind": "wandb"}}],
)  # fmt: skip
def test_what_changes_no_update_may_differ(tmp_path, changes):
    claim(tmp_path)
    claim(tmp_path, **changes)
    claim(tmp_path, **changes, resume="x")
    assert OmegaConf.load(tmp_path / "config.yaml") == configured(**changes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seed": 1}, r"\(seed: 0 there, 1 now\)"),
        ({"optim": {"tau": 0.1}}, r"\(optim\.tau: 'nothing' there, 0\.1 now\)"),
    ],
)
def test_other_settings_are_refused_by_key_unless_forced(
    tmp_path, caplog, changes, named
):
    claim(tmp_path)
    changes = changes | {"logger": {"kind": "wandb"}}
    with pytest.raises(ValueError, match=f"holds a run.*{named}.*force=true"):
        claim(tmp_path, **changes)
    assert OmegaConf.load(tmp_path / "config.yaml") == CONFIG
    claim(tmp_path, **changes, force=True)
    assert "by force=true" in caplog.text
    assert OmegaConf.load(tmp_path / "config.yaml") == configured(**changes)


@pytest.mark.parametrize("force", [False, True])
def test_a_run_never_goes_back(tmp_path, force):
    claim(tmp_path)
    with pytest.raises(ValueError, match="with trainer.steps=5, and 4 are fewer"):
        claim(tmp_path, trainer={"steps": 4}, force=force)
    assert OmegaConf.load(tmp_path / "config.yaml") == CONFIG


def test_a_run_whose_checkpoints_do_not_fit_is_what_it_was(tmp_path):
    claim(tmp_path)
    (tmp_path / "status.json").write_text('{"status": "done"}')
    with (
        pytest.raises(CheckpointError),
        run_folder.claimed(tmp_path, configured(seed=1, force=True), JOB),
        run_folder.status(tmp_path),
    ):
        raise CheckpointError("5 tensors differ")
    assert OmegaConf.load(tmp_path / "config.yaml") == CONFIG
    assert run_folder.read_status(tmp_path) == {"status": "done"}


def test_overrides_replace_settings_of_the_run(tmp_path):
    claim(tmp_path, seed=3)
    config = resumed(tmp_path, "trainer.steps=7")
    assert (config.seed, config.trainer.steps) == (3, 7)


def test_overrides_that_are_no_settings_are_refused(tmp_path):
    claim(tmp_path)
    with pytest.raises(ValueError, match="preset=paper is none of its settings"):
        resumed(tmp_path, "preset=paper")


def test_resuming_needs_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder of a run"):
        resumed(tmp_path)


@pytest.mark.parametrize("content", ["- a list", "a: &a [1]\nb: *a", "a: [", "\x00"])
def test_damaged_configuration_is_named(tmp_path, content):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(ValueError, match=r"^config\.yaml "):
        resumed(tmp_path)


def read_status(folder) -> dict:
    return json.loads((folder / "status.json").read_text())


@pytest.mark.parametrize("error", [ValueError("why"), KeyboardInterrupt("why")])
def test_status_says_failed_and_why(tmp_path, error):
    with pytest.raises(type(error)), run_folder.status(tmp_path):
        raise error
    assert read_status(tmp_path) == {
        "status": "failed",
        "error": f"{type(error).__name__}: why",
    }


HOLDER = """
import sys
from pathlib import Path
from torchrl_osr.lab.run import run_folder
folder = Path(sys.argv[1])
with run_folder.lock(folder), run_folder.status(folder):
    print("training", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_in_the_folder_is_told_who_is_there(tmp_path, caplog):
    arguments = [sys.executable, "-c", HOLDER, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(arguments, **pipes) as holder:
        assert holder.stdout.readline() == "training\n"
        message = f"process {holder.pid} on .* is training in .*choose another folder"
        with pytest.raises(ValueError, match=message), run_folder.lock(tmp_path):
            raise AssertionError("both would write the same files")
        said = read_status(tmp_path)
        assert said["pid"] == holder.pid, "left as it was"
        process = f"process {holder.pid} on {platform.node()}"
        at_work = said | {"reason": f"{process} is at work"}
        assert run_folder.read_status(tmp_path) == at_work
        holder.kill()
    # A lock does not outlive its process.
    killed = said | {"status": "killed", "reason": f"{process} is gone"}
    assert run_folder.read_status(tmp_path) == killed
    with run_folder.lock(tmp_path), run_folder.status(tmp_path):
        assert read_status(tmp_path)["pid"] == os.getpid()
    assert f"was begun by {process} and did not end" in caplog.text


def test_process_of_another_machine_is_not_guessed_about(tmp_path):
    said = {"status": "running", "pid": os.getpid(), "host": "elsewhere"}
    run_folder.write_json(tmp_path / "status.json", said)
    found = run_folder.read_status(tmp_path)
    assert found["status"] == "running"
    here = platform.node()
    assert found["reason"] == (
        f"process {os.getpid()} on elsewhere; {here} cannot see whether it still runs"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["status.json"]


def test_a_full_disk_is_said_to_leave_the_status(tmp_path, monkeypatch, caplog):
    def full(_):
        raise OSError(28, "No space left on device")

    def fail():
        monkeypatch.setattr(os, "fsync", full)
        raise ValueError("why")

    with pytest.raises(ValueError, match="why"), run_folder.status(tmp_path):
        fail()
    assert read_status(tmp_path)["status"] == "running"
    assert "No space left" in caplog.text
    assert "still says that the run is running" in caplog.text


@pytest.mark.parametrize("made_anew", [False, True])
def test_folder_that_is_gone_at_the_end_is_no_success(tmp_path, made_anew):
    folder, message = tmp_path / "run", "removed or renamed while the run was going on"
    folder.mkdir()
    other = {"status": "running", "pid": 1, "host": "elsewhere"}

    def move():
        folder.rename(tmp_path / "elsewhere")
        if made_anew:
            folder.mkdir()
            run_folder.write_json(folder / "status.json", other)

    with pytest.raises(FileNotFoundError, match=message), run_folder.status(folder):
        move()
    if made_anew:
        assert read_status(folder) == other, "another run's"
    else:
        assert not folder.exists()


@pytest.mark.parametrize(("name", "code"), [("TERM", 75), ("HUP", 75), ("INT", 130)])
def test_signal_outside_of_the_training_ends_the_run_in_order(
    tmp_path, caplog, name, code
):
    def stop():
        os.kill(os.getpid(), signal.Signals[f"SIG{name}"])
        pytest.fail("not reached")

    with pytest.raises(Interrupted) as raised, run_folder.status(tmp_path):
        stop()
    assert raised.value.code == code
    assert read_status(tmp_path)["status"] == "preempted"
    assert f"stopped by SIG{name}" in read_status(tmp_path)["reason"]
    assert f"torchrl-osr train resume={tmp_path}" in caplog.text


def test_interrupted_run_is_preempted_and_says_how_to_continue(tmp_path, caplog):
    folder = tmp_path / "0_loss=cql,seed=1"
    folder.mkdir()
    with pytest.raises(Interrupted), run_folder.status(folder):
        raise Interrupted("saved at step 3", 75)
    assert read_status(folder) == {"status": "preempted", "reason": "saved at step 3"}
    # Quoted for Hydra, and then for the shell.
    assert f"""resume='"'"'{folder}'"'"''""" in caplog.text


def test_run_of_modules_of_ones_own_has_to_be_trusted_again(tmp_path, caplog):
    trust = ["my_losses", "my_arms"]
    with pytest.raises(Interrupted), run_folder.status(tmp_path, trust):
        raise Interrupted("saved at step 3", 75)
    *_, line = caplog.text.strip().splitlines()
    _, command = line.split("Continue with: ")
    _, _, *overrides = shlex.split(command)
    assert overrides == [f"resume={tmp_path}", "trust=[my_losses,my_arms]"]


def test_failed_write_keeps_the_old_file_and_names_it(tmp_path, monkeypatch):
    path = tmp_path / "file.json"
    run_folder.write_json(path, [1])

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left.*file\.json"):
        run_folder.write_json(path, [2])
    assert json.loads(path.read_text()) == [1]
    assert [each.name for each in tmp_path.iterdir()] == ["file.json"]


def test_figures_that_do_not_exist_are_null(tmp_path):
    path = tmp_path / "file.json"
    run_folder.write_json(path, {"a": [float("nan"), 1.5], "b": -float("inf")})
    assert json.loads(path.read_text()) == {"a": [None, 1.5], "b": None}
