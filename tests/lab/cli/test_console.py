"""The console: help and versions, errors as sentences, completion."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys

import pytest
from composed import composed
from omegaconf import OmegaConf

from torchrl_osr import __version__
from torchrl_osr.lab.__main__ import COMMANDS, main
from torchrl_osr.lab.cli.console import sentence, single_job


def test_help_names_every_command_and_fits_a_screen(capsys):
    main(["--help"])
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert len(lines) <= 30
    assert max(map(len, lines)) <= 80
    assert re.findall(r"(?m)^  (\w+)  +[a-z]", printed) == list(COMMANDS)
    main([])
    assert capsys.readouterr().out == printed


def test_version_names_what_decides_the_numbers(capsys):
    main(["--version"])
    printed = capsys.readouterr().out
    assert printed.startswith(f"torchrl-osr {__version__}, python 3.")
    assert {"torch", "torchrl", "mujoco"} <= set(printed.replace(",", "").split())


def test_unknown_command_is_told_which_there_are():
    with pytest.raises(SystemExit, match=r"no command 'trian'; it has data, train, "):
        main(["trian"])


def composition_error(*overrides: str) -> Exception:
    try:
        composed("train", *overrides)
    except Exception as error:
        return error
    raise AssertionError("it was accepted")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("sed=1", "there is no key 'sed'; --cfg job prints all that are."),
        ("loss.sed=1", "there is no key 'loss.sed'; --cfg job prints all that are."),
        ("loss=sql", r"loss has no option 'sql'; it has .*cql, .*osr, .*td3_bc\."),
        ("seed=a", "Error merging override seed=a: Value 'a' .* to Integer"),
        ("outputs/run", r"cannot read 'outputs/run' as key=value: missing EQUAL .*\."),
    ],
)
def test_wrong_override_is_one_sentence(override, said):
    assert re.fullmatch(said, sentence(composition_error(override)))


def test_other_errors_are_one_sentence():
    with pytest.raises(Exception, match="Missing") as missing:
        _ = OmegaConf.create({"checkpoint": "???"}).checkpoint
    assert sentence(missing.value).startswith("checkpoint is missing: give checkpoint=")
    assert (
        sentence(ValueError("seed must be at least 0.")) == "seed must be at least 0."
    )
    package = ModuleNotFoundError("No module named 'hydra'", name="hydra")
    assert sentence(package) == "'hydra' is missing: pip install 'torchrl-osr[train]'"
    full = OSError(28, "Cannot write a.json: [Errno 28] No space left on device")
    assert sentence(full) == "Cannot write a.json: No space left on device"
    no_log = ValueError("Unable to configure handler 'file'")  # so does logging.config
    no_log.__cause__ = PermissionError(13, "Permission denied", "run/train.log")
    assert sentence(no_log) == "cannot write a log: Permission denied: 'run/train.log'"
    # A defect of ours: there is no sentence to it.
    assert sentence(KeyError("x")) == "KeyError: 'x'\nIts traceback: add --debug."


def test_error_is_alone_and_debug_shows_where(tmp_path, run):
    wrong = ["loss.chunk_size=0", "hydra.run.dir=run"]
    message = "chunk_size must be at least 1, got 0."
    code, output = run(tmp_path, "train", *wrong)
    assert code == 1
    *logged, told = output.splitlines()
    assert told == message
    assert all(line.startswith("[") and "[INFO]" in line for line in logged)
    log = (tmp_path / "run" / "train.log").read_text()
    assert "Traceback (most recent call last)" in log
    assert log.endswith(f"ValueError: {message}\n")
    code, output = run(tmp_path, "evaluate", "checkpoint=nowhere", "--debug")
    assert code == 1
    assert output.startswith("Traceback")
    assert "FileNotFoundError: there is no run" in output


def test_screen_is_not_for_what_matplotlib_logs(caplog):
    def job(cfg):
        logging.getLogger("matplotlib.font_manager").info("generated new fontManager")
        logging.getLogger("torchrl_osr").info("step 1")

    caplog.set_level(logging.INFO)
    single_job(job)(None)
    assert caplog.messages == ["step 1"]


def test_example_is_the_command_by_another_name(tmp_path, run):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    more = "# @package _global_\ntrainer: {steps: 7}\n"
    (tmp_path / "mine" / "experiment" / "short.yaml").write_text(more)
    options = ["--config-dir", "mine", "+experiment=short", "--cfg", "job"]
    code, output = run(tmp_path, "offline_osr.py", *options)
    assert code == 0, output
    assert OmegaConf.create(output).trainer.steps == 7


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("torchrl-osr", " ".join(COMMANDS)),
        ("torchrl-osr ev", " ".join(COMMANDS)),
        ("torchrl-osr report ru", ""),
    ],
)
def test_completion_offers_commands_first(monkeypatch, capsys, line, offered):
    monkeypatch.setenv("COMP_LINE", line)
    main(["-sc", "query=bash"])
    assert capsys.readouterr().out.strip() == offered


COMPLETE = """
eval "$INSTALLED"
complete -p torchrl-osr
COMP_LINE="torchrl-osr evaluate suite=to"
COMP_WORDS=($COMP_LINE) COMP_CWORD=2 COMP_POINT=${#COMP_LINE} COMPREPLY=()
hydra_bash_completion
echo "${COMPREPLY[*]}"
"""


def test_bash_completes_a_commands_groups(tmp_path, run):
    code, installed = run(tmp_path, "-sc", "install=bash")
    assert code == 0, installed
    program = tmp_path / "torchrl-osr"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m torchrl_osr.lab "$@"\n')
    program.chmod(0o755)
    done = subprocess.run(
        ["bash", "-c", COMPLETE], cwd=tmp_path, capture_output=True, text=True,
        timeout=240, check=False,
        env=os.environ
        | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "INSTALLED": installed},
    )  # fmt: skip
    assert done.stderr == ""
    defined, completed = done.stdout.splitlines()
    assert defined.endswith("-F hydra_bash_completion torchrl-osr")
    assert completed == "suite=torque"
