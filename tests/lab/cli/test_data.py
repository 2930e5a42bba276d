"""A log is looked at before anything is trained on it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from composed import composed

from torchrl_osr.lab.cli import data
from torchrl_osr.lab.run.config import checked


@pytest.fixture
def look(tmp_path, monkeypatch, capsys):
    """Return a function that runs the command in a folder of its own: its output."""
    monkeypatch.chdir(tmp_path)

    def look(*overrides: str) -> str:
        data.main(composed("check_data", *overrides, "progress=false"))
        return capsys.readouterr().out

    return look


def write_log(path, **changes):
    rng = np.random.default_rng(0)
    rows = np.arange(1200)
    angle = rng.uniform(-3, 3, 1200)
    columns = {"cos": np.cos(angle), "sin": np.sin(angle), "speed": 8 * np.sin(angle)}
    columns["torque"] = rng.uniform(-2, 2, 1200)
    columns |= {"reward": -(angle**2), "timeout": (rows % 200 == 199).astype(int)}
    pd.DataFrame(columns).assign(**changes).to_csv(path, index=False)


NAMED = [
    "data.path=log.csv", "data.columns.observation=[cos,sin,speed]",
    "data.columns.action=torque", "data.columns.terminated=false",
]  # fmt: skip


def test_a_log_is_described(look, tmp_path):
    write_log("log.csv", note=7)
    output = look(*NAMED, "env.id=Pendulum-v1")
    assert "log.csv: 1,200 rows, 6 episodes" in output
    assert "0 terminated, 6 truncated, 0 unmarked" in output
    assert "200 (200 to 200), 6 complete episodes" in output
    assert "-2.0 to 2.0 become -1 to 1" in output
    assert "not read  note" in output
    assert re.search(r"(?m)^action +torque +-1.99\d? ", output)
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]
    assert look(*NAMED) == look(*NAMED, "env=none")


def test_what_looks_wrong_is_numbered(look):
    write_log("log.csv", speed=0.5)
    swapped = [*NAMED[:1], "data.columns.observation=[speed,cos,sin]", *NAMED[2:]]
    assert "1. speed is 0.5 in every row" in look(*swapped, "env.id=Pendulum-v1")


@pytest.mark.parametrize(
    ("changes", "overrides", "message"),
    [
        ({}, ["data.columns.action=force"], "action=force names 0 columns"),
        ({"sin": "left"}, [], "'sin' holds other than numbers"),
        ({"torque": 5.0}, [], "'action' leaves its bounds in 1200 of 1200 rows"),
        ({}, ["data.path=other.csv"], "there is no file"),
        ({}, ["data.path=null"], "data=file needs data.path="),
    ],
)
def test_what_cannot_be_trained_on_is_one_sentence(look, changes, overrides, message):
    write_log("log.csv", **changes)
    with pytest.raises((ValueError, OSError), match=message):
        look(*NAMED, "data.action_bounds=[-2,2]", *overrides)


def test_a_file_names_the_columns_of_an_observation_by_keys(look):
    rng = np.random.default_rng(0)
    names = ["x", "y", "goal_x", "goal_y", *"abcd", "u", "v"]
    frame = pd.DataFrame(rng.uniform(-1, 1, (600, 10)), columns=names)
    frame.assign(reward=0.0, end=1 * (frame.index % 100 == 99)).to_csv("maze.csv")
    named = "observation: [x, y, goal_x, goal_y, a, b, c, d]\naction: [u, v]\n"
    Path("columns.yaml").write_text(f"{named}terminated: false\ntruncated: end\n")
    maze = "env=pointmaze-umaze", "data=file", "data.path=maze.csv"
    output = look(*maze, "data.columns=columns.yaml")
    assert re.search(r"y -> achieved_goal\[1\] .*\n +goal_x -> desired_goal", output)
    assert "text      separator ',', decimal '.'" in output
    read = checked(composed("train", *maze, "data.columns=columns.yaml")).data
    assert (read.columns.action, read.num_transitions) == (["u", "v"], None)


def test_rolled_out_data_too(look):
    mixed = ["data.num_transitions=300", "data.random_share=0.5"]
    output = look("data=medium", "env=hopper", *mixed)
    assert "300 rows" in output
    assert "observation[10]" in output
