"""The console: help, versions, and errors as sentences."""

from __future__ import annotations

import re

import pytest
from composed import composed
from omegaconf import OmegaConf

from torchrl_osr import __version__
from torchrl_osr.lab.__main__ import COMMANDS, main
from torchrl_osr.lab.cli.console import sentence


def test_help_lists_every_command(capsys):
    main([])
    printed = capsys.readouterr().out
    assert re.findall(r"(?m)^  (\w+)  +[a-z]", printed) == list(COMMANDS)


def test_version_begins_with_the_package(capsys):
    main(["--version"])
    start = f"torchrl-osr {__version__}, python 3."
    assert capsys.readouterr().out.startswith(start)


def test_unknown_command_lists_commands():
    with pytest.raises(SystemExit, match=r"no command 'trian'; it has data, train, "):
        main(["trian"])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sed=1", "there is no key 'sed'; its group has .*seed, resume, "),
        ("loss.num_randm=1", "there is no key 'loss.num_randm'; .*num_random, "),
        ("loss=sql", "loss has no option 'sql'; it has .*iql, .*osr"),
        ("seed=a", "Error merging override seed=a: Value 'a' .* to Integer"),
    ],
)
def test_wrong_override_is_one_sentence(override, message):
    with pytest.raises(Exception, match=r".") as error:
        composed("train", override)
    assert re.match(message, sentence(error.value))
    assert "\n" not in sentence(error.value)


def test_other_errors_are_one_sentence():
    with pytest.raises(Exception, match="Missing") as missing:
        _ = OmegaConf.create({"checkpoint": "???"}).checkpoint
    assert sentence(missing.value) == "Missing mandatory value: checkpoint"
    assert sentence(ValueError("seed is too large.")) == "seed is too large."
    package = ModuleNotFoundError("No module named 'hydra'", name="hydra")
    assert "'hydra'. Commands need what 'torchrl-osr[train]'" in sentence(package)
    # A defect of ours: there is no sentence to it.
    assert sentence(KeyError("x")) == "KeyError: 'x'\nIts traceback: add --debug."


def test_error_is_printed_once_and_debug_shows_where(tmp_path, run):
    wrong = ["loss.recovery_weight=-1", "hydra.run.dir=run"]
    code, output = run(tmp_path, "train", *wrong)
    assert code == 1
    printed = output.splitlines()[-1]
    assert "recovery_weight" in printed
    assert "Traceback" not in output
    log = (tmp_path / "run" / "train.log").read_text()
    assert "Traceback (most recent call last)" in log
    code, output = run(tmp_path, "evaluate", "checkpoint=nowhere", "--debug")
    assert code == 1
    assert output.startswith("Traceback")
    assert "FileNotFoundError: there is no run" in output


def test_a_mistyped_folder_to_resume_is_not_left_behind(tmp_path, run):
    code, output = run(tmp_path, "train", "resume=outputs/typo")
    assert code == 1
    assert "resume=outputs/typo: there is no config.yaml in it" in output
    assert list(tmp_path.iterdir()) == []
