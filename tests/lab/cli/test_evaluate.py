"""Train a tiny run, disturb it: the two examples as a user runs them."""

from __future__ import annotations

import json
import re
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import composed
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhDelta

from torchrl_osr.lab.cli import evaluate as example
from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.dynamics.training import FILE, write_dynamics
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.lab.evaluation.recoverable import load_recoverable_states, recovers
from torchrl_osr.lab.evaluation.robustness import impossible_disturbances
from torchrl_osr.lab.report import read_runs
from torchrl_osr.lab.run.recoverable import states_for
from torchrl_osr.lab.run.suite import make_disturbances
from torchrl_osr.lab.run.switching import load_switching_policy
from torchrl_osr.lab.run.trained_run import checkpoints_of, load_trained

ROOT = Path(__file__).parents[3]
CONF = ROOT / "conf/evaluation"
SUITES = sorted(path.stem for path in (CONF / "suite").glob("*.yaml"))
DISTURBING = sorted(set(SUITES) - {"recoverable"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run, tiny) -> Path:
    """A run with three checkpoints."""
    cwd = tmp_path_factory.mktemp("evaluate")
    sizes = tiny(steps=30, eval_interval=30, eval_episodes=2)
    code, output = run(cwd, "train", *sizes, "hydra.run.dir=run")
    assert code == 0, output
    return cwd / "run"


@pytest.fixture(scope="module")
def evaluated(folder, run) -> str:
    """Run as a user would; the other tests take it from there."""
    options = ["checkpoint=run", "episodes=2", "last=2", "progress=false"]
    code, output = run(folder.parent, "evaluate", *options)
    assert code == 0, output
    return output


def quiet(*overrides: str):
    return composed("evaluate", "progress=false", *overrides)


def test_table_json_and_figure_are_left_in_the_runs_folder(folder, evaluated):
    names = list(quiet("checkpoint=run").suite.disturbances)
    results = json.loads((folder / "robustness-oos.json").read_text())
    assert results["format"] == 1
    assert results["suite"] == "oos"
    assert (results["env"], results["data"]) == ("hopper", "random")
    assert {"torchrl_osr", "torch", "mujoco"} < results["versions"].keys()
    assert results["threshold"] > 0
    assert [each["step"] for each in results["evaluations"]] == [20, 30]
    seeds = [each["clean"]["seeds"] for each in results["evaluations"]]
    assert seeds == [[20_000, 20_001], [21_000, 21_001]]
    for each in results["evaluations"]:
        assert [level["name"] for level in each["levels"]] == names
        for level in each["levels"]:
            assert level["seeds"] == each["clean"]["seeds"]
            assert len(level["returns"]) == len(level["scores"]) == 2
    assert [row["name"] for row in results["summary"]] == names
    assert (folder / "robustness-oos.png").read_bytes().startswith(b"\x89PNG")
    for name in names:
        assert name in evaluated
    assert "run/robustness-oos.json" in evaluated
    assert "Warning" not in evaluated
    left = {path.name for path in folder.parent.iterdir()}
    assert left == {"run"}, "nothing is left where it was called from"


def test_finished_evaluation_is_not_done_again(folder, evaluated, capsys):
    path = folder / "robustness-oos.json"
    before = path.stat().st_mtime_ns
    same = ["episodes=2", "last=2", f"checkpoint={folder}"]
    example.main(quiet(*same))
    assert "is there already" in capsys.readouterr().out
    assert path.stat().st_mtime_ns == before
    content = json.loads(path.read_text())
    example.main(quiet(*same, "force=true"))
    assert path.stat().st_mtime_ns > before
    assert json.loads(path.read_text()) == content, "the same numbers again"
    with pytest.raises(ValueError, match=r"other settings \(seed\): force=true"):
        example.main(quiet(*same, "seed=5"))
    with pytest.raises(ValueError, match="results of 2 checkpoints, these 1 among"):
        example.main(quiet(*same, "last=1"))
    assert json.loads(path.read_text()) == content
    example.main(quiet(*same, "seed=5", "force=true"))
    assert json.loads(path.read_text())["evaluations"] != content["evaluations"]


def test_killed_evaluation_goes_on_to_the_same_bytes(folder, monkeypatch, capsys):
    """From the first checkpoint that was not done, and without the network."""
    same = quiet(f"checkpoint={folder}", "episodes=2", "suite=start")
    path, partial = (
        folder / name
        for name in ("robustness-start.json", ".robustness-start.partial.json")
    )
    played = []
    play = example.evaluate_paired

    def dying(*args, **options):
        played.append(options["seed"])
        if len(played) == 3:
            raise SystemExit("killed")
        return play(*args, **options)

    def refuse(*_):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(example, "evaluate_paired", dying)
    with pytest.raises(SystemExit):
        example.main(same)
    assert not path.exists()
    assert len(json.loads(partial.read_text())["evaluations"]) == 2
    assert "start" not in read_runs([folder]).suites, "a part is no result"
    example.main(same)
    assert played == [20_000, 21_000, 22_000, 22_000]
    assert "has 2 of 3 checkpoints already" in capsys.readouterr().out
    assert not partial.exists()
    continued = path.read_bytes()
    monkeypatch.setattr(example, "evaluate_paired", play)
    path.unlink()
    # What another request has left, and what is damaged, is not continued.
    other = json.loads(continued) | {"seed": 1}
    for left in (json.dumps(other), continued[:100].decode()):
        partial.write_text(left)
        example.main(quiet(f"checkpoint={folder}", "episodes=2", "suite=start"))
        assert path.read_bytes() == continued
        assert not partial.exists()
        path.unlink()
    assert f"{partial} is ignored" in capsys.readouterr().out


def test_one_checkpoint_has_a_file_of_its_own(folder):
    best = folder / "checkpoint" / "policy" / "best.torchrl"
    example.main(quiet(f"checkpoint={best}", "episodes=2", "suite=start"))
    results = json.loads((folder / "best-robustness-start.json").read_text())
    assert len(results["evaluations"]) == 1
    assert not (folder / "robustness-start.json").exists()


def test_every_suite_is_possible_for_another_environment(folder):
    env_id = "Walker2d-v5"
    trained = load_trained(folder)
    environment = make_environment(env_id)
    scale = np.full(environment.observation_space.shape, 0.5)
    environment.close()
    for name in DISTURBING:
        suite = quiet(f"suite={name}", "checkpoint=none").suite
        assert suite.name == name
        made = make_disturbances(suite.disturbances, trained, scale)
        assert len(made) >= 3
        assert not impossible_disturbances(env_id, made)


@pytest.mark.parametrize(
    ("overrides", "error", "named"),
    [
        (["episodes=1"], ValueError, "episodes=1"),
        (["last=0"], ValueError, "last must be between 1 and"),
        (["sweep=runs"], ValueError, "either checkpoint=.* or sweep="),
        (["checkpoint=null"], ValueError, "either checkpoint=.* or sweep="),
        (["checkpoint=null", "sweep=."], ValueError, "no finished run in or below"),
        (["checkpoint=nowhere"], FileNotFoundError, "nowhere"),
        (["checkpoint=/"], FileNotFoundError, r"config\.yaml"),
        (["suite.disturbances.mass.kindd=a"], ConfigCompositionException, "kindd"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, folder, overrides, error, named):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=named):
        example.main(quiet(f"checkpoint={folder}", *overrides))


def test_attacks_need_standardised_networks_and_a_stochastic_policy(folder):
    cfg = quiet("suite=observation_attack", "checkpoint=none")
    suite, trained = cfg.suite, load_trained(folder)
    deterministic = ProbabilisticActor(
        TensorDictModule(torch.nn.Linear(11, 3), ["observation"], ["param"]),
        in_keys=["param"],
        distribution_class=TanhDelta,
    )
    scale = np.full(11, 0.5)
    left_out = example.impossible(cfg, trained._replace(actor=deterministic), scale)
    assert set(left_out) == {each for each in suite.disturbances if "diff" in each}
    assert "the policy's is a TanhDelta" in left_out["action_diff-0.05"]
    assert not example.impossible(cfg, trained, scale)
    trained.config.data.standardize = False
    with pytest.raises(ValueError, match="no disturbance .*data.standardize=false"):
        example.impossible(cfg, trained, scale)
    suite.disturbances["random-0.05"].attack = None
    with pytest.raises(ValueError, match="'random-0.05' needs either wrap or attack"):
        make_disturbances(suite.disturbances, trained, scale)


@pytest.mark.parametrize("script", ["evaluate"])
def test_help_has_every_key_and_fits_a_screen(tmp_path, run, script):
    code, output = run(tmp_path, script, "--help")
    assert code == 0, output
    lines = output.strip().splitlines()
    assert len(lines) <= 28
    assert max(map(len, lines)) <= 80
    told = output.split("Keys:")[1].split("--cfg job")[0]
    config = OmegaConf.load(CONF / f"{script}.yaml")
    keys = [*(set(config) - {"defaults", "hydra"}), *["suite"][: script == "evaluate"]]
    assert set(re.findall(r"(?m)^  (\w+) ", told)) == set(keys)
    if script == "evaluate":
        named = re.search(r"suite +(.*?)\n  \w", told, re.DOTALL)[1]
        assert sorted(re.split(r",\s+", named)) == SUITES


def test_sweep_evaluates_every_finished_run(tmp_path, folder, run):
    for name in ("0_good", "1_damaged", "2_running"):
        shutil.copytree(folder, tmp_path / "sweep" / name)
    (tmp_path / "sweep" / "2_running" / "status.json").write_text(
        '{"status": "running"}'
    )
    damaged = tmp_path / "sweep" / "1_damaged"
    for path in (damaged / "checkpoint" / "policy").glob("checkpoint-*"):
        path.write_bytes(path.read_bytes()[:100])
    options = ["sweep=sweep", "jobs=2", "suite=start", "episodes=2", "last=1"]
    code, output = run(tmp_path, "evaluate", *options)
    assert code == 1
    lines = output.splitlines()
    assert lines[0] == "left out: sweep/2_running: not finished, its status is running"
    assert lines[-1] == "1 of 2 runs failed: sweep/1_damaged."
    assert re.search(r"of 2: sweep/1_damaged: failed: checkpoint .* is damaged", output)
    assert re.search(r"(?m)^  sweep/0_good +-?\d+\.\d +-?\d+\.\d$", output)
    assert (tmp_path / "sweep" / "0_good" / "robustness-start.json").exists()


def test_recoverable_states_are_played_from(folder, capsys):
    same = ["suite=recoverable", "last=2"]
    example.main(quiet(f"checkpoint={folder}", *same))
    results = json.loads((folder / "recoverable-public.json").read_text())
    states = load_recoverable_states("hopper", "public")
    assert [each["step"] for each in results["evaluations"]] == [20, 30]
    trained = load_trained(checkpoints_of(folder)[-1])
    policy = deterministic_policy(trained.actor, trained.observation_norm)
    back = recovers(states, policy)
    assert results["evaluations"][-1]["back"] == back.astype(int).tolist()
    easy = states.group == "easy"
    mean = np.mean([each["back"] for each in results["evaluations"]], axis=0)
    line = rf"(?m)^  easy +{easy.sum()} +{100 * mean[easy].mean():.0f} +\["
    assert re.search(line, capsys.readouterr().out)
    example.main(quiet(f"sweep={folder}", *same))
    rows = rf"{folder} +(\d+ *){{3}}\n"
    assert re.search(rows, capsys.readouterr().out)
    assert read_runs([folder]).saved["back"].tolist() == mean.tolist()
    # Fallen at once, as anything is that has learned nothing.
    assert not back[states.group == "recoverable"].any()


def test_runs_of_a_sweep_are_one_policy_that_switches(folder, tmp_path, capsys):
    runs = [tmp_path / name for name in ("a/run", "b/run")]
    for run in runs:
        shutil.copytree(folder, run)
        torch.manual_seed(len(run.parts))
        model = DynamicsEnsemble(11, 3, num_networks=2, num_elites=1, num_cells=[4])
        write_dynamics(run / FILE, model, {"direction of time": "forward"})
    for file in (runs[1] / "checkpoint" / "policy").glob("checkpoint-*30.torchrl"):
        file.unlink()  # so that they differ: its last step is 20
    sweep = [f"sweep={tmp_path}", "switching=true"]
    example.main(quiet(*sweep, "suite=recoverable"))
    results = json.loads((tmp_path / "switching-recoverable-public.json").read_text())
    last = "checkpoint/policy/checkpoint-0000000000"
    assert list(results["checkpoints"]) == [
        f"a/run/{last}30.torchrl", f"b/run/{last}20.torchrl"
    ]  # fmt: skip
    states = load_recoverable_states("hopper", "public")
    back = recovers(states, load_switching_policy(runs))
    assert results["evaluations"][0]["back"] == back.astype(int).tolist()
    assert "hopper random, public recoverable states\n" in capsys.readouterr().out

    example.main(quiet(*sweep, "suite=push", "episodes=2"))
    results = json.loads((tmp_path / "switching-robustness-push.json").read_text())
    assert len(results["evaluations"]) == 1
    assert results["summary"]
    assert (tmp_path / "switching-robustness-push.png").exists()
    with pytest.raises(ValueError, match="nobody attacks a choice"):
        example.main(quiet(*sweep, "suite=observation_attack"))
    with pytest.raises(ValueError, match="switching=true is for sweep="):
        example.main(quiet(f"checkpoint={folder}", "switching=true"))


def test_a_task_without_recoverable_states_is_named(folder):
    config = OmegaConf.load(folder / "config.yaml")
    config.env.id = "Hopper-v4"
    with pytest.raises(ValueError, match=r"of Hopper-v5, and the run is of Hopper-v4"):
        states_for(config, "public")
    config.env.name = "cart"
    with pytest.raises(ValueError, match=r"'halfcheetah', 'hopper',.* got 'cart'"):
        states_for(config, "public")


def test_every_key_and_suite_is_documented():
    page = (ROOT / "docs" / "robustness.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"(?m)^\| `([\w.]+)` \| `(.+?)` \|", page))
    cfg = OmegaConf.to_container(quiet())
    del cfg["suite"]
    assert cfg.keys() == {key for key in rows if key in cfg}
    for key, value in cfg.items():
        if value != "???" and key != "progress":
            assert OmegaConf.create(f"[{rows[key]}]")[0] == value, key
    for name in SUITES:
        assert f"| `{name}` |" in page
