"""Populations as a user starts them: processes on a CPU, one update elsewhere."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import zipfile
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from torchrl_osr.experiment import schema as config
from torchrl_osr.experiment.trained_run import load_trained
from torchrl_osr.trainers import OfflineTrainer, members, processes
from torchrl_osr.trainers.members import launch, make_members

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "offline_osr.py"
LAST = "checkpoint/policy/checkpoint-000000000020.torchrl"


@pytest.fixture(scope="module")
def sizes(tiny) -> list[str]:
    return tiny(inverse_dynamics_steps=20, steps=20, eval_interval=20)


def composed(*overrides: str) -> DictConfig:
    config.register()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("offline_osr", overrides=list(overrides))


@pytest.fixture(scope="module")
def train(load_example, sizes):
    """Return a function that does in here what the example does: the score."""
    script = load_example("offline_osr.py")

    def train(folder: Path, *overrides: str) -> float:
        cfg = composed(*sizes, *overrides)
        return launch(cfg, folder, SCRIPT, overrides, script.prepare_data, script.run)

    return train


@pytest.fixture(scope="module")
def alone(tmp_path_factory, train) -> Path:
    """Return the folder of a single run: that of the first member below."""
    folder = tmp_path_factory.mktemp("alone")
    train(folder, "seed=1", "loss.recovery_weight=1.0")
    return folder


MEMBERS = "population=[{seed:1,loss.recovery_weight:1.0},{optim.actor_lr:1e-3}]"
NAMES = ["member0-seed1-recovery_weight1.0", "member1-actor_lr0.001"]


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    """Return networks and the generators of a run's last checkpoint."""
    found = {}
    with zipfile.ZipFile(folder / LAST) as archive:
        for name in archive.namelist():
            if name.endswith("state.pt") and "optimizer" not in name:
                content = io.BytesIO(archive.read(name))
                state = torch.load(content, weights_only=True)
                found |= {
                    key: each for key, each in state.items() if torch.is_tensor(each)
                }
    return found


def files(folder: Path) -> set[str]:
    logs = {"offline_osr.log", "output.log"}
    below = {str(each.relative_to(folder)) for each in folder.rglob("*")}
    return {each for each in below if Path(each).name not in logs}


def assert_done(*folders: Path) -> None:
    for folder in folders:
        text = (folder / "status.json").read_text()
        assert json.loads(text) == {"status": "done"}


def test_processes_end_with_the_bits_of_single_runs(tmp_path, run, sizes, alone):
    arguments = [*sizes, MEMBERS, "hydra.run.dir=run"]
    code, output = run(tmp_path, SCRIPT.name, *arguments)
    assert code == 0, output
    assert "Warning" not in output
    population = tmp_path / "run"
    folder, other = (population / name for name in NAMES)
    assert_done(population, folder, other)
    mine, theirs = tensors(folder), tensors(alone)
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[key], theirs[key]) for key in theirs)
    for name in ("config.yaml", "returns.json", "inverse_dynamics.json"):
        assert (folder / name).read_text() == (alone / name).read_text()
    assert files(folder) == files(alone) | {".hydra", ".hydra/overrides.yaml"}
    overrides = OmegaConf.load(folder / ".hydra" / "overrides.yaml")
    assert set(overrides) == {*sizes, "seed=1", "loss.recovery_weight=1.0"}
    assert files(other) == files(folder)
    for each in (folder, other):
        assert "policy, best evaluation" in output.split(str(each))[1]
    assert load_trained(folder).step == 20


def test_one_update_for_all_ends_with_the_numbers_of_single_runs(
    tmp_path, monkeypatch, train, alone, capsys
):
    """Both phases; broken off in the second and continued."""
    monkeypatch.setattr(members, "_on_cpu", lambda cfg: False)
    folder, other = (tmp_path / name for name in NAMES)
    save = OfflineTrainer.save_trainer

    def broken_off(trainer: OfflineTrainer, *arguments, **options):
        if trainer.rotation.directory == other / "checkpoint/policy":
            raise KeyboardInterrupt
        save(trainer, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(OfflineTrainer, "save_trainer", broken_off)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path, MEMBERS)
    for each in (tmp_path, folder, other):
        assert "KeyboardInterrupt" in (each / "status.json").read_text()
    score = train(tmp_path, MEMBERS)
    assert_done(tmp_path, folder, other)
    mine, theirs = tensors(folder), tensors(alone)
    assert mine.keys() == theirs.keys()
    for key, value in theirs.items():
        assert torch.allclose(mine[key].double(), value.double(), atol=1e-5), key
    assert files(folder) == files(alone) | {".hydra", ".hydra/overrides.yaml"}
    assert files(other) == files(folder)
    assert (folder / "config.yaml").read_text() == (alone / "config.yaml").read_text()
    last = [
        json.loads((each / "returns.json").read_text())["last"]
        for each in (folder, other)
    ]
    assert score == pytest.approx(sum(each["score"] for each in last) / 2)
    assert str(other) in capsys.readouterr().out


def test_run_from_before_there_were_populations_is_continued(load_example, alone):
    script = load_example("offline_osr.py")
    cfg = OmegaConf.load(alone / "config.yaml")
    del cfg["population"]
    assert launch(cfg, alone, SCRIPT, [], script.prepare_data, script.run) >= 0


def make_script(folder: Path, body: str) -> Path:
    """Write a script that is started as a member, its folder being ``folder``."""
    path = folder / "script.py"
    lines = ["import sys, time, pathlib", "folder = sys.argv[1][8:-1]", body]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_failed_member_is_named_and_the_others_go_on(tmp_path, capsys):
    folders = [tmp_path / f"it's {name}" for name in "abc"]
    for each in folders:
        each.mkdir()
    unquote = 'folder = folder.replace("\\\\\'", "\'")'
    body = f"{unquote}\nprint('Here', folder)\nsys.exit(folder[-1] == 'b')"
    with pytest.raises(RuntimeError, match="1 of 3 members failed.*it's b"):
        processes.train_in_processes(make_script(tmp_path, body), folders, 2)
    output = capsys.readouterr().out
    assert all(f"Here {each}" in output for each in folders)


def test_at_most_so_many_at_once_and_none_when_broken_off(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in "abc"]
    for each in folders:
        each.mkdir()
    started = []

    class Watched(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    def broken_off(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(processes.subprocess, "Popen", Watched)
    monkeypatch.setattr(processes.time, "sleep", broken_off)
    script = make_script(tmp_path, "time.sleep(60)")
    with pytest.raises(KeyboardInterrupt):
        processes.train_in_processes(script, folders, 2)
    assert [process.returncode for process in started] == [-signal.SIGTERM] * 2


def test_process_that_was_left_behind_is_not_joined_by_another(tmp_path):
    left = {"status": "running", "pid": os.getpid()}
    (tmp_path / "status.json").write_text(json.dumps(left))
    with pytest.raises(RuntimeError, match=f"worked on by process {os.getpid()}"):
        processes.train_in_processes(SCRIPT, [tmp_path], 1)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["population=0"], "number of seeds, at least 1.*got 0"),
        (["population=true"], "got True"),
        (["population=[]"], r"got \[\]"),
        (["population=[1,2]"], r"got \[1, 2\]"),
        (["population=some"], "got 'some'"),
        (["population=[{sed:0}]"], "member 0: there is no key 'sed'"),
        (["population=[{seed:0},{network.num_cells:[4]}]"], "member 1: network.num_ce"),
        (["population=[{loss.num_qvalue_nets:4}]"], "loss.num_qvalue_nets must be the"),
        (["population=[{trainer.steps:4}]"], "trainer.steps must be the same"),
        (["population=[{data.seed:4}]"], "data.seed must be the same"),
        (["population=[{loss:cql}]"], "loss must be the same"),
        (["population=[{population:2}]"], "population: member 0"),
        (["population=[{seed:often}]"], "member 0: seed='often': .*Integer"),
        (["population=[{loss.recovery_weight:0},{seed:1}]"], r"is \[0.0, 0.5\]"),
        (
            ["population=2", "trainer.device=cuda", "trainer.compile=true"],
            "trainer.compile=true",
        ),
    ],
)
def test_bad_populations_are_named(overrides, named):
    with pytest.raises(ValueError, match=named):
        make_members(composed(*overrides), Path("run"))


def test_members_have_their_own_values_and_folders():
    cfg = composed("population=3", "seed=5", "loss=osr_v")
    made = make_members(cfg, Path("run"))
    assert [each.config.seed for each in made] == [5, 6, 7]
    assert [each.folder for each in made] == [
        Path(f"run/member{index}-seed{5 + index}") for index in range(3)
    ]
    rows = "population=[{loss.min_q_weight:1,seed:0},{optim.tau:0.1}]"
    first, second = make_members(composed(rows), Path("run"))
    assert first.config.loss.min_q_weight == 1.0
    assert second.config.loss.min_q_weight == 5.0
    assert (second.config.optim.tau, second.config.population) == (0.1, None)
    assert second.folder.name == "member1-tau0.1"
