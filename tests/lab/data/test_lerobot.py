"""A folder that LeRobot's own writer wrote."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from composed import composed, trained
from lerobot_pendulum import LENGTHS, REACHED, make_episodes

from torchrl_osr.lab.cli import data as data_command
from torchrl_osr.lab.data import load_dataset
from torchrl_osr.lab.run.monitor import MonitorConfig, monitor_of_run

PENDULUM = Path(__file__).parent / "lerobot_pendulum"
INFO = Path("meta", "info.json")


def load(path=PENDULUM, **options):
    options = {"action_bounds": (-2, 2)} | options
    return load_dataset(None, "lerobot", path=path, progress=False, **options)


@pytest.fixture
def edited(tmp_path):
    """Return a function that copies the set with other tables."""

    def edited(change):
        shutil.copytree(PENDULUM, tmp_path / "set")
        path = tmp_path / "set" / INFO
        info = json.loads(path.read_text())
        for file in (tmp_path / "set").glob("data/*/*"):
            table = change(pd.read_parquet(file))
            table.to_parquet(file)
        info["features"] = {name: {"dtype": "float32"} for name in table}
        path.write_text(json.dumps(info))
        return tmp_path / "set"

    return edited


def test_rows_are_those_that_lerobot_was_given():
    data, manifest = load()
    episodes = make_episodes()
    for each, reached in zip(episodes, REACHED, strict=True):
        state = each["observation.state"]
        each["next"] = np.concatenate([state[1:], state[-1:]])
        # Where the goal is not reached, the state after the last row is unknown.
        rows = len(state) - (not reached)
        each |= {name: column[:rows] for name, column in each.items()}
    for key, name, scale in (
        ("observation", "observation.state", 1),
        ("action", "action", 2),
        (("next", "reward"), "next.reward", 1),
        (("next", "observation"), "next", 1),
    ):
        given = np.concatenate([each[name] for each in episodes]) / scale
        assert torch.equal(data[key], torch.from_numpy(given)), key
    last = np.cumsum([len(each["action"]) for each in episodes]) - 1
    assert data["next", "done"].nonzero()[:, 0].tolist() == last.tolist()
    assert data["next", "terminated"][last, 0].tolist() == REACHED
    assert manifest["episode_lengths"] == LENGTHS
    returns = [each["next.reward"].sum() for each in make_episodes()]
    np.testing.assert_allclose(manifest["episode_returns"], returns, rtol=1e-6)
    unseen = "images and videos are left out: observation.images.top."
    assert manifest["warnings"] == [unseen]


def test_a_set_without_rewards_can_be_cloned(edited):
    path = edited(lambda table: table.drop(columns="next.reward"))
    _, manifest = load(path)
    assert manifest["warnings"][-1].startswith("The data have no reward column: name")


def without_success(table):
    return table.drop(columns="next.success")


def with_truncated(table):
    return table.assign(**{"next.truncated": table["next.done"] & (table["index"] > 9)})


@pytest.mark.parametrize(
    ("change", "columns", "terminated"),
    [
        (without_success, {"terminated": False}, 0),
        (without_success, {"terminated": "next.done"}, 5),
        (with_truncated, {}, 1),
        (with_truncated, {"terminated": "next.success"}, 2),
        (lambda table: table.assign(cut=table["index"] > 9), {"truncated": "cut"}, 1),
        (lambda table: table, {"reward": "timestamp"}, 2),
    ],
)
def test_columns_and_terminal_ends_are_chosen(edited, change, columns, terminated):
    data, manifest = load(edited(change), columns=columns)
    assert data["next", "terminated"].sum() == terminated == manifest["terminated_ends"]
    assert len(manifest["episode_lengths"]) == 5
    if "reward" in columns:
        assert data["next", "reward"][:8, 0] == pytest.approx(np.arange(8) / 20)


@pytest.mark.parametrize("flag", ["terminated", "truncated"])
def test_a_flag_that_is_no_flag_is_refused(edited, flag):
    with pytest.raises(ValueError, match=f"'{flag}' holds 0.4.*expected bool"):
        load(edited(lambda table: table), columns={flag: "timestamp"})


def test_a_folder_that_cannot_be_read_is_an_error_with_its_cure(edited, tmp_path):
    path = edited(without_success)
    with pytest.raises(ValueError, match=r"lack terminated.*data\.columns\.term"):
        load(path)
    file = path / "data" / "chunk-000" / "file-001.parquet"
    file.write_bytes(file.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"file-001.* cut short .*: copy it again, or"):
        load(path, columns={"terminated": False})
    file.unlink()
    with pytest.raises(ValueError, match="holds 24 rows where meta/info.json says 40"):
        load(path, columns={"terminated": False})
    (path / INFO).write_text('{"codebase_version": "v2.1"}')
    with pytest.raises(ValueError, match=r"format v2\.1; .*convert_dataset_v21_to_v30"):
        load(path)
    with pytest.raises(FileNotFoundError, match="meta/info.json"):
        load(tmp_path)


def test_the_commands_read_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ["env=none", "data=lerobot", f"data.path={PENDULUM}"]
    data_command.main(composed("check_data", *given, "progress=false"))
    output = capsys.readouterr().out
    assert "lerobot_pendulum: 40 rows, 5 episodes" in output
    assert "2 terminated, 3 truncated, 0 unmarked" in output
    assert "1. images and videos are left out: observation.images.top." in output
    assert [name in output for name in ("cos", "speed", "torque")] == [True] * 3
    folder = trained(tmp_path / "run", *given, "data.held_out=0.2")
    assert json.loads((folder / "inverse_dynamics.json").read_text())["rows"] > 0
    monitor_of_run(folder, MonitorConfig(0.5, fall_steps=0, episodes=str(PENDULUM)))
    assert "monitor: an alarm beyond" in capsys.readouterr().out
