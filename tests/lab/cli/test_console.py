"""The console: help, versions, and errors as sentences."""

from __future__ import annotations

import re
import subprocess
import sys
import uuid

import pytest
from composed import composed
from omegaconf import OmegaConf

from torchrl_osr import __version__
from torchrl_osr.lab.__main__ import COMMANDS, main
from torchrl_osr.lab.cli.console import sentence


def test_help_and_an_unknown_command_list_commands_and_version_packages(capsys):
    main([])
    printed = capsys.readouterr().out
    assert re.findall(r"(?m)^  ([\w-]+)  +[a-z]", printed) == list(COMMANDS)
    main(["--version"])
    assert capsys.readouterr().out.startswith(f"torchrl-osr {__version__}, python 3.")
    with pytest.raises(SystemExit, match=r"'trian' \(did you mean 'train'\?\); it has"):
        main(["trian"])


def test_help_is_quick_and_has_no_raw_configuration():
    """Without importing torch; the test of ``train`` compares its options."""
    code = (
        "import sys, torchrl_osr.lab.__main__ as lab\n"
        "lab.main([]); [lab.main([name, '--help']) for name in lab.CONFIGS]\n"
        "sys.exit('torch' in sys.modules)"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert "half-widths of their bounds" in printed
    assert "action_low" not in printed


QUOTED = "cannot be read: quote a value with blanks, brackets or quotes, as in "


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sed=1", r"there is no key 'sed' \(did you mean 'seed'\?\); .*, resume, "),
        ("loss.num_randm=1", r"there.*_randm' \(did you mean 'num_random'.*, alpha_i"),
        ("inverse_dynamics.loss.latent_wieght=1", "there is no key .*'latent_weight'"),
        ("loss.max_q_backup=perhaps", "Error merging override .* 'perhaps' .* bool"),
        ("inverse_dynamics.loss.states=clen", r"Error .* 'clen', .* of \[both, clean"),
        ("loss.num_random=1.5", "Error merging override .* '1.5' .* to Integer"),
        ("data=medum", r"data has no option 'medum' \(did you mean 'medium'\?\); it"),
        ("seed=a", "Error merging override seed=a: Value 'a' .* to Integer"),
        ("seed=0,1", "seed=0,1 has several values: add -m to run each, write a list"),
        ("data.path=a,b.npz", ".*, as in 'data.path=\"a,b.npz\"'"),
        ("data.path=log (1).csv", f".*{QUOTED}'data.path=\"log \\(1\\).csv\"'"),
        ("data.path=it's.csv", f".*{QUOTED}'data.path=\"it'\"'\"'s.csv\"'"),
        ("seed", "'seed' is no key=value"),
        ("loss=sdc,recovery=osr", "this loss has a recovery term of its own: leave"),
    ],
)
def test_wrong_override_is_one_sentence(override, message):
    with pytest.raises(Exception, match=r".") as error:
        composed("train", *re.split(",(?=recovery)", override))
    assert re.match(message, sentence(error.value)), sentence(error.value)
    assert "\n" not in sentence(error.value)


def test_other_errors_are_one_sentence():
    with pytest.raises(Exception, match="Missing") as missing:
        _ = OmegaConf.create({"checkpoint": "???"}).checkpoint
    assert sentence(missing.value) == "Missing mandatory value: checkpoint"
    assert sentence(ValueError("seed is too large.")) == "seed is too large."
    package = ModuleNotFoundError("No module named 'hydra'", name="hydra")
    assert "'hydra'. Commands need what 'torchrl-osr[train]'" in sentence(package)
    assert sentence(FileNotFoundError(2, "no", "a.xml")) == "there is no file a.xml."
    with pytest.raises(ValueError, match="invalid literal") as foreign:
        uuid.UUID("x" * 32)
    assert sentence(foreign.value).startswith("ValueError: invalid literal")
    # A defect of ours: there is no sentence to it.
    assert sentence(KeyError("x")) == "KeyError: 'x'\nIts traceback: add --debug."


def test_error_is_printed_once_and_debug_shows_where(tmp_path, run):
    wrong = ["loss.recovery_weight=-1", "hydra.run.dir=run"]
    output = run(tmp_path, "train", *wrong, code=1)
    assert "recovery_weight" in output.splitlines()[-1]
    assert "Traceback" not in output
    log = (tmp_path / "run" / "train.log").read_text()
    assert "Traceback (most recent call last)" in log
    output = run(tmp_path, "evaluate", "checkpoint=nowhere", "--debug", code=1)
    assert output.startswith("Traceback")
    assert "FileNotFoundError: there is no run" in output


def test_a_mistyped_folder_is_not_left_behind_and_home_is_expanded(
    tmp_path, run, monkeypatch
):
    monkeypatch.setenv("HOME", f"{tmp_path}/home")
    output = run(tmp_path, "train", "resume=~/outputs/typo", code=1)
    start = f"resume={tmp_path}/home/outputs/typo: there is no config.yaml in it; give"
    assert output.startswith(start)
    given = "data.columns=names.yaml", "data.columns.reward=goal"
    output = run(tmp_path, "data", *given, code=1)
    assert output.startswith("data.columns=<file> replaces all data.columns.<part>")
    assert list(tmp_path.iterdir()) == []
