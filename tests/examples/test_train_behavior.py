from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from torchrl_osr.lab.data import (
    collect_transitions,
    load_behavior_policy,
    make_environment,
)
from torchrl_osr.lab.data.behavior import load_behavior_card


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run) -> Path:
    folder = tmp_path_factory.mktemp("policies")
    # A process of its own, as a user runs it: torchrl's collectors warn on import.
    arguments = {
        "env": "InvertedPendulum-v5",
        "out": folder,
        "steps": 192,
        "random-steps": 96,
        "eval-every": 96,
        "eval-steps": 200,
        "card-steps": 400,
        "batch-size": 16,
    }
    options = [f"--{name}={value}" for name, value in arguments.items()]
    code, output = run(folder, "train_behavior.py", *options)
    assert code == 0, output
    return folder


def test_card_lists_every_file(folder: Path) -> None:
    card = load_behavior_card(folder)["invertedpendulum"]
    files = {path.stem for path in (folder / "invertedpendulum").glob("*.npz")}
    assert card["env"] == "InvertedPendulum-v5"
    assert set(card["policies"]) == files
    assert files == {"medium", "expert", *(f"replay_{n}" for n in range(1, 9))}
    for entry in card["policies"].values():
        assert entry["steps"] in (96, 192)
        assert entry["stochastic_return"][0] > 0
        assert entry["episodes"] > 0


def test_saved_policies_load_and_play(folder: Path) -> None:
    policy = load_behavior_policy("invertedpendulum", "replay_1", folder=folder)
    with closing(make_environment("InvertedPendulum-v5")) as env:
        data, returns, _ = collect_transitions(env, [policy.sample], 100)
    assert data.shape == (100,)
    assert returns.min() >= 0


def test_nothing_else_is_written(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert names == {"card.json", "invertedpendulum"}
