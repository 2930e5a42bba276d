"""Collect, train, evaluate and report in environments that nobody has prepared."""

from __future__ import annotations

import json
import os
import re
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from composed import composed
from composed import trained as trained_on
from gymnasium.envs.classic_control import PendulumEnv

from torchrl_osr.lab.cli import collect, data, evaluate, evaluate_offline
from torchrl_osr.lab.data import environment_spec
from torchrl_osr.lab.report import read_runs, write_report
from torchrl_osr.lab.report.runs import find_runs
from torchrl_osr.lab.run.config import read_run
from torchrl_osr.lab.run.evaluate_offline import OfflineEvaluator
from torchrl_osr.lab.run.folder import read_status
from torchrl_osr.lab.run.load import load_run_policy


def record(path: Path, *overrides: str) -> None:
    collect.main(composed("collect", f"path={path}", "progress=false", *overrides))


def trained(folder: Path, *overrides: str) -> Path:
    return trained_on(folder, "data=file", "trainer.eval_episodes=2", *overrides)


def disturbed(folder: Path, *more: str) -> dict:
    given = (f"checkpoint={folder}", "episodes=2", "last=1", "progress=false", *more)
    evaluate.main(composed("evaluate", *given))
    return json.loads((folder / "robustness-oos.json").read_text())


MUJOCO = {"push-1.0", "push-2.0", "start-noise-0.2", "mass-1.5"}


@pytest.mark.parametrize(
    ("env_id", "loss", "bounds", "left_out"),
    [
        ("Pendulum-v1", "osr", ([-2.0], [2.0]), MUJOCO),
        ("CartPole-v1", "discrete_osr", (None, None), MUJOCO | {"knock-official-15"}),
    ],
)
def test_from_nothing_to_a_report(env_id, loss, bounds, left_out, tmp_path, capsys):
    log, run = tmp_path / "log.npz", tmp_path / "run"
    record(log, f"env.id={env_id}", "episodes=20")
    hint = f"train env.id={env_id} {'loss=discrete_osr ' * (loss != 'osr')}data=file"
    assert hint in capsys.readouterr().out
    trained(run, f"env.id={env_id}", f"loss={loss}", f"data.path={log}")
    env = read_run(run).env
    assert (env.name, env.action_low, env.action_high) == (env_id, *bounds)
    last = json.loads((run / "returns.json").read_text())["last"]
    assert last["return"] == np.mean(last["returns"])
    assert not [key for key in last if "score" in key]
    assert "return [95 % interval]" in capsys.readouterr().out

    results = disturbed(run)
    assert results["left_out"].keys() == left_out
    printed = capsys.readouterr().out
    assert "\N{MINUS SIGN}" not in printed, "Windows' pipes lack it"
    assert printed.count("left out: ") == len(left_out)
    title, header, *rows, _ = printed[printed.index(f"{env_id} file") :].splitlines()
    assert title.endswith("suite oos: 1 x 2 pairs of episodes, mean returns [95 %]")
    assert header.split()[:3] == ["disturbance", "clean", "disturbed"]
    assert len(rows) == 9 - len(left_out)
    clean = np.mean(results["evaluations"][0]["clean"]["returns"])
    assert all(row.split()[1] == f"{clean:.1f}" for row in rows)
    page = write_report(read_runs([tmp_path]), tmp_path / "page").read_text()
    assert f"return of {env_id}" in page

    better = tmp_path / "better.npz"
    record(better, f"policy={run}", "episodes=2", "noise=0.1")
    with np.load(better) as columns:
        size = environment_spec(env_id).observation_size
        assert columns["observation"].shape == (len(columns["reward"]), size)
    policy = load_run_policy(run)
    policy.record["source"]["env_id"] = f"json:{env_id}"
    policy.save(saved := tmp_path / "stranger.safetensors")
    with pytest.raises(ValueError, match=r"allow it with trust=\[json\]"):
        record(tmp_path / "x.npz", f"policy={saved}")
    record(tmp_path / "x.npz", f"policy={saved}", f"env.id={env_id}", "episodes=1")


def test_a_run_knows_its_data_by_their_contents(tmp_path):
    record(log := tmp_path / "log.npz", "env.id=Pendulum-v1", "episodes=3")
    given = "env.id=Pendulum-v1", "loss=td3_bc"
    run = trained(tmp_path / "run", *given, f"data.path={log}")
    more = f"resume={run}", "trainer.steps=20"
    log.rename(moved := tmp_path / "moved.npz")
    with pytest.raises(FileNotFoundError, match=r"no file .*log\.npz"):
        disturbed(run)
    disturbed(run, f"data.path={moved}")
    with np.load(moved) as columns:
        changed = {name: 2 * columns[name] for name in ("observation", "reward")}
        np.savez(log, **{**columns, **changed})
    refused = r"data.path=.*log\.npz has other contents .* began with: give data.path="
    for play in partial(disturbed, run, "force=true"), partial(trained_on, run, *more):
        with pytest.raises(ValueError, match=refused):
            play()
    assert read_status(run)["status"] == "done", "it is as it was"
    trained_on(run, more[0], f"data.path={moved}")
    assert read_run(run).data.path == str(moved)
    fixed = trained(tmp_path / "fixed", *given, f"data.path={log}")
    os.replace(log, moved)
    trained_on(run, *more, "force=true")
    assert read_run(run).data.checksum == read_run(fixed).data.checksum
    assert torch.equal(load_run_policy(run).loc, load_run_policy(fixed).loc)


def test_a_run_that_fails_before_its_training_is_none(tmp_path):
    """A corrected command may use its folder; references of one's own make scores."""
    given = "env.id=Pendulum-v1", f"data.path={tmp_path}/log.npz"
    with pytest.raises(FileNotFoundError, match="no file"):
        trained(tmp_path / "run", *given, "loss=osr")
    assert find_runs([tmp_path]) == []
    record(tmp_path / "log.npz", "env.id=Pendulum-v1", "episodes=3")
    given += "loss=td3_bc", "env.random_return=-1200", "env.expert_return=-200"
    run = trained(tmp_path / "run", *given)
    last = json.loads((run / "returns.json").read_text())["last"]
    assert last["score"] == pytest.approx((last["return"] + 1200) / 10)


class Late(PendulumEnv):
    """Fails later than the steps that are tried before the training, if it is told."""

    broken = False

    def step(self, action):
        self.steps += 1
        if self.broken and self.steps > 20:
            raise ConnectionError("motor driver")
        return super().step(action)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return super().reset(seed=seed)


def test_evaluations_that_fail_are_told_when_the_policy_is_saved(tmp_path):
    gymnasium.register("Late-v0", Late, max_episode_steps=30)
    record(log := tmp_path / "log.npz", "env.id=Late-v0", "episodes=10")
    given = "env.id=Late-v0", "loss=td3_bc", f"data.path={log}"
    run = trained(tmp_path / "run", *given)
    Late.broken = True
    failed = r"the policy is saved, .* in Late-v0 failed: step 20: ConnectionError: mot"
    with pytest.raises(RuntimeError, match=failed):
        trained(run, *given, "trainer.steps=20")
    assert load_run_policy(run).record["source"]["step"] == 20


def test_without_a_simulator_a_log_still_makes_a_policy(tmp_path, capsys):
    record(log := tmp_path / "log.npz", "env.id=Pendulum-v1", "episodes=3")
    with np.load(log) as columns:
        action, changed = columns["action"], {**columns}
    given = "env=none", f"data.path={log}"
    run = trained(tmp_path / "run", *given)
    assert "the policy is trained, and was never played" in capsys.readouterr().out
    assert (run / "curve.png").exists()
    assert json.loads((run / "returns.json").read_text())["evaluations"] == []
    env = read_run(run).env
    margin = 0.05 * np.ptp(action)
    assert env.action_low == pytest.approx([action.min() - margin])
    assert env.action_high == pytest.approx([action.max() + margin])
    trained(run, *given, "trainer.steps=20")
    np.savez(log, **changed | {"reward": 2 * changed["reward"]})
    more = f"resume={run}", "trainer.steps=30"
    with pytest.raises(ValueError, match=r"log\.npz has other contents"):
        trained_on(run, *more)
    trained_on(run, *more, "force=true")
    log.unlink()  # from here on the run is enough
    policy = load_run_policy(run)
    assert (policy.low, policy.high) == (*env.action_low, *env.action_high)
    assert policy.act(np.zeros((2, 3), np.float32)).shape == (2, 1)
    with pytest.raises(ValueError, match=r"^log-log has no simulator \(env=none\)"):
        disturbed(run)


def test_a_log_without_rewards_trains_what_needs_none(tmp_path, capsys):
    record(log := tmp_path / "log.npz", "env.id=Pendulum-v1", "episodes=3")
    with np.load(log) as columns:
        np.savez(log, **{name: columns[name] for name in columns if name != "reward"})
    given = "env=none", f"data.path={log}"
    with pytest.raises(ValueError, match=r"no reward column: .* or loss=bc recovery="):
        trained(tmp_path / "osr", *given, "loss=osr")
    assert find_runs([tmp_path]) == []
    for loss in (["loss=noisy_bc"], ["loss=bc", "recovery=osr"]):
        run = trained(tmp_path / loss[-1], *given, *loss)
        assert json.loads((run / "returns.json").read_text())["data_return"] is None
    assert (run / "inverse_dynamics.json").exists()
    capsys.readouterr()
    data.main(composed("check_data", "progress=false", *given))
    shown = capsys.readouterr().out
    assert "1. The data have no reward column" in shown
    assert "returns " not in shown


def test_policies_are_ranked_on_their_log_alone(tmp_path, capsys, monkeypatch):
    record(log := tmp_path / "log.npz", "env.id=Pendulum-v1", "episodes=3")
    given = "env=none", f"data.path={log}"
    runs = [trained(tmp_path / loss, *given, f"loss={loss}") for loss in ("bc", "iql")]
    command = ["torchrl-osr", *map(str, runs), "--steps", "5", "--discount", "0.9"]
    monkeypatch.setattr("sys.argv", command)
    evaluate_offline.main()
    found = [json.loads((run / "offline_evaluation.json").read_text()) for run in runs]
    with np.load(log) as columns:
        rewards = columns["reward"].reshape(3, 200)[:, :199]  # the last has no next
    own = (rewards @ 0.9 ** np.arange(199)).mean()
    for each in found:
        assert each["value_low"] < each["value"] < each["value_high"]
        assert each["data_value"] == pytest.approx(own, rel=1e-5)
    table = capsys.readouterr().out.split("estimated discounted return")[-1]
    best = max(zip(found, runs, strict=True), key=lambda pair: pair[0]["value"])[1]
    assert table.index(str(best)) == min(table.index(str(run)) for run in runs)
    assert "from the first states of 3 episodes" in table
    monkeypatch.setattr("sys.argv", [*command, "--checkpoints"])
    evaluate_offline.main()
    table = capsys.readouterr().out.split("estimated discounted return")[-1]
    newest = max((runs[0] / "checkpoint" / "policy").glob("checkpoint-*.torchrl"))
    assert table.count(str(newest)) in (1, 2)  # and in the command, if it is the best
    assert "To use the first: torchrl-osr export" in table
    monkeypatch.setattr("sys.argv", command)
    log.unlink()
    evaluate_offline.main()  # the results are there already
    page = write_report(read_runs([tmp_path]), tmp_path / "page").read_text()
    name = "estimated return by FQE (discount 0.9) of log-log"
    assert f"Undisturbed {name}" in page
    assert "No run was played." in page
    bodys = json.loads((runs[0] / "offline_evaluation.json").read_text())
    bodys |= {"value": 0.0, "values": [3 * bodys["value"]]}
    (runs[0] / "body-offline_evaluation.json").write_text(json.dumps(bodys))
    scores = pd.read_csv(tmp_path / "page" / "scores.csv", index_col="method")
    by_body = read_runs([tmp_path]).episodes.groupby("method")["score"].mean()
    assert by_body["bc"] == pytest.approx(3 * found[0]["value"])
    for loss, each in zip(("bc", "iql"), found, strict=True):
        assert scores.loc[loss, "last"] == pytest.approx(each["value"])
    assert scores["data mean"].tolist() == pytest.approx([own, own], rel=1e-5)


def test_runs_that_read_one_log_in_two_ways_have_their_own_rows(tmp_path):
    record(log := tmp_path / "log.npz", "env.id=Pendulum-v1", "episodes=3")
    with np.load(log) as columns:
        np.savez(log, **columns, profit=-columns["reward"])
    given = "env=none", f"data.path={log}", "data.columns.observation=observation"
    runs = [
        trained(tmp_path / name, "loss=bc", *given, f"data.columns.reward={name}")
        for name in ("reward", "profit")
    ]
    evaluate = OfflineEvaluator(steps=5)
    cost, profit = (evaluate(run)["data_value"] for run in runs)
    assert cost == -profit < 0


def test_bounds_and_discrete_actions_may_be_given(tmp_path, capsys, monkeypatch):
    record(log := tmp_path / "real.npz", "env.id=Pendulum-v1", "episodes=3")
    given = "env=none", f"data.path={log}", "data.action_bounds=[-3,2.5]", "loss=td3_bc"
    env = read_run(trained(tmp_path / "real", *given)).env
    assert (env.action_low, env.action_high, env.name) == ([-3], [2.5], "log-real")
    record(log := tmp_path / "whole.npz", "env.id=CartPole-v1", "episodes=3")
    given = "env=none", f"data.path={log}", "loss=discrete_osr"
    with pytest.raises(ValueError, match=r"give their number .*env\.action_size="):
        trained(tmp_path / "whole", *given)
    run = trained(tmp_path / "whole", *given, "env.action_size=2")
    trained(run, *given, "env.action_size=2", "trainer.steps=20")
    assert load_run_policy(run).act(np.zeros(4)) in (0, 1)
    with pytest.raises(ValueError, match="env.id is not given"):
        record(tmp_path / "more.npz", f"policy={run}")
    for option in ("data.path=/log.npz", "--frame-skip=0"):
        monkeypatch.setattr("sys.argv", ["torchrl-osr", str(run), option])
        with pytest.raises(SystemExit):
            evaluate_offline.main()
        assert re.search("no run; options|skip 0; expected", capsys.readouterr().err)
    monkeypatch.setattr("sys.argv", ["torchrl-osr", str(run), "--steps", "5"])
    evaluate_offline.main()
    assert "value " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env.id=Pendulum-v1", "path=there.npz"], "there.npz exists"),
        (["path=log.npz"], "env.id is not given"),
        (["env=hopper", "path=a.npz", "policy=good"], "no run .* at good"),
        (["env=hopper", "path=a.npz", "policy=no:act"], "no:act: No module named 'no'"),
    ],
)
def test_collect_refuses_in_a_sentence(overrides, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.npz").write_bytes(b"mine")
    with pytest.raises((ValueError, OSError, ImportError), match=message):
        collect.main(composed("collect", *overrides))
    assert (tmp_path / "there.npz").read_bytes() == b"mine"
