"""The main example as a user runs it: in processes of its own, a few steps each."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import version

import pytest
from composed import CONF


@pytest.fixture(scope="module")
def sizes(tiny) -> list[str]:
    return tiny(
        inverse_dynamics_steps=30, steps=40, eval_interval=20, eval_episodes=2,
        checkpoint_interval=20,
    )  # fmt: skip


def test_run_leaves_table_figure_returns_and_checkpoints(tmp_path, sizes):
    # A process that imports torch itself.
    command = [sys.executable, "-m", "torchrl_osr.lab", "train", "hydra.run.dir=run"]
    options = {"cwd": tmp_path, "text": True, "stderr": subprocess.STDOUT}
    output = subprocess.check_output([*command, *sizes], **options)
    folder = tmp_path / "run"
    assert "held-out rows: NLL" in output
    for label in ("data, mean episode", "policy, last", "policy, best evaluation"):
        assert label in output
    assert json.loads((folder / "status.json").read_text()) == {"status": "done"}
    returns = json.loads((folder / "returns.json").read_text())
    assert returns["versions"]["torchrl"] == version("torchrl")
    assert [row["step"] for row in returns["evaluations"]] == [0, 20, 40]
    assert len(returns["last"]["returns"]) == 2
    assert returns["last"] == returns["evaluations"][-1]
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "csv" / "scalars" / "policy" / "recovery_kl.csv").exists()
    for name in ("policy.safetensors", "checkpoint/policy/best.torchrl"):
        assert (folder / name).exists()
    assert "Warning" not in output
    assert "Traceback" not in output
    log = (folder / "train.log").read_text()
    lines = re.findall(r"policy: (\d+)/40 \[.*, score [\d.-]+\]$", log, re.MULTILINE)
    assert lines == ["0", "20", "40"]
    assert all(line in output for line in log.splitlines())


def test_a_sweep_names_the_job_that_failed_and_ends_the_others(tmp_path, run, sizes):
    """Over the classes that no other test here trains; its flag may come last."""
    chosen = ["loss=osr_v,sdc,edac_10,iql,rorl", "dynamics=none"]
    given = [*sizes, *chosen, "hydra.sweep.dir=sweep", "-m"]
    output = run(tmp_path, "train", *given, code=1)
    assert re.search(r"/sweep/\S*sdc\S*: .*choose dynamics=ensemble", output)
    assert "Warning" not in output
    folders = list((tmp_path / "sweep").glob("*/returns.json"))
    assert len(folders) == 4
    for path in folders:
        assert json.loads(path.read_text())["last"]["step"] == 40


def test_recovery_is_added_from_training_to_the_page(tmp_path, run, sizes):
    def typed(*arguments: str) -> None:
        assert "Warning" not in run(tmp_path, *arguments)

    chosen = ["loss=rebrac", "recovery=osr", "trainer.steps=20"]
    typed("train", *sizes, *chosen, "hydra.run.dir=run")
    typed("train", "resume=run", "env=hopper", "trainer.steps=40")  # said once more
    scalars = tmp_path / "run" / "csv" / "scalars" / "policy"
    for name in ("loss_recovery", "recovery_kl", "loss_qvalue"):
        assert (scalars / f"{name}.csv").read_text()
    typed("evaluate", "checkpoint=run", "suite=start", "episodes=2", "last=1")
    typed("export", "run", "policy.safetensors")
    typed("report", "run")
    assert "rebrac+osr" in (tmp_path / "report/report.html").read_text(encoding="utf-8")


def test_official_preset_with_its_model_runs_in_half_precision(tmp_path, run, sizes):
    arguments = [*sizes, "preset=official", "trainer.precision=bfloat16"]
    run(tmp_path, "train", *arguments, "hydra.run.dir=run")
    config = (tmp_path / "run" / "config.yaml").read_text()
    assert "standardize: false" in config
    assert "cvae_inverse_dynamics" in config


def test_help_lists_the_options_of_every_group(tmp_path, run):
    output = run(tmp_path, "train", "--help")
    offered = output.split("Groups and ")[1].split("Set any key")[0]
    names = set(re.findall(r"[\w-]+(?=[,\n])", offered))
    groups = (
        *("env", "data", "inverse_dynamics", "dynamics", "loss", "recovery"),
        *("logger", "preset"),
    )
    files = {path.stem for group in groups for path in CONF.glob(f"{group}/*.yaml")}
    launchers = {"pool", "cluster", "submitit_slurm", "submitit_local"}
    assert names - {"basic"} == files | launchers
