"""A run's folder: never two configurations in one, never half a file."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from torchrl_osr.experiment import run_folder
from torchrl_osr.trainers import Interrupted

CONFIG = {"seed": 0, "resume": None, "trainer": {"steps": 5, "progress": True}}


def configured(**changes):
    return OmegaConf.merge(OmegaConf.create(CONFIG), changes)


def test_configuration_is_written_and_read_back(tmp_path):
    run_folder.claim(tmp_path / "new" / "run", configured())
    overrides = ["resume=x", "trust=[mine]"]
    assert run_folder.saved_config(tmp_path / "new" / "run", overrides) == CONFIG


def test_same_configuration_may_continue(tmp_path):
    run_folder.claim(tmp_path, configured())
    run_folder.claim(tmp_path, configured())
    # These change no number.
    run_folder.claim(tmp_path, configured(resume="x", trainer={"progress": False}))


def test_another_configuration_is_refused_by_key(tmp_path):
    run_folder.claim(tmp_path, configured())
    with pytest.raises(ValueError, match=r"trainer\.steps: 5 there, 6 now") as error:
        run_folder.claim(tmp_path, configured(trainer={"steps": 6}))
    assert "seed" not in str(error.value)
    assert run_folder.saved_config(tmp_path, []) == CONFIG


def test_resuming_takes_no_other_override(tmp_path):
    run_folder.claim(tmp_path, configured())
    with pytest.raises(ValueError, match="leave out seed=1"):
        run_folder.saved_config(tmp_path, ["resume=x", "seed=1"])


def test_resuming_needs_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder of a run"):
        run_folder.saved_config(tmp_path, ["resume=x"])


@pytest.mark.parametrize("content", ["- a list", "a: &a [1]\nb: *a", "a: [", "\x00"])
def test_damaged_configuration_is_named(tmp_path, content):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(ValueError, match=r"^config\.yaml "):
        run_folder.saved_config(tmp_path, ["resume=x"])


def read_status(folder) -> dict:
    return json.loads((folder / "status.json").read_text())


def test_status_says_running_then_done(tmp_path):
    with run_folder.status(tmp_path):
        assert read_status(tmp_path)["status"] == "running"
    assert read_status(tmp_path) == {"status": "done"}


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
from torchrl_osr.experiment import run_folder
with run_folder.status(Path(sys.argv[1])):
    print("training", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_in_the_folder_is_told_who_is_there(tmp_path):
    arguments = [sys.executable, "-c", HOLDER, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(arguments, **pipes) as holder:
        assert holder.stdout.readline() == "training\n"
        message = f"process {holder.pid} on .* is training in .*choose another folder"
        with pytest.raises(ValueError, match=message), run_folder.status(tmp_path):
            raise AssertionError("both would write the same files")
        assert read_status(tmp_path)["pid"] == holder.pid, "left as it was"
        holder.kill()
    # A lock does not outlive its process.
    with run_folder.status(tmp_path):
        assert read_status(tmp_path)["pid"] == os.getpid()


def test_interrupted_run_is_preempted_and_says_how_to_continue(tmp_path, caplog):
    folder = tmp_path / "0_loss=cql,seed=1"
    folder.mkdir()
    with pytest.raises(Interrupted), run_folder.status(folder):
        raise Interrupted("saved at step 3", 75)
    assert read_status(folder) == {"status": "preempted", "reason": "saved at step 3"}
    # Quoted for Hydra, and then for the shell.
    assert f"""resume='"'"'{folder}'"'"''""" in caplog.text


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
