"""The mazes as a user runs them: an ant's log, a point of our own, disturbances."""

from __future__ import annotations

import json

import numpy as np
import pytest
from composed import composed

from torchrl_osr.lab.cli import collect, evaluate


@pytest.fixture
def train(tmp_path, run, tiny):
    """Return a function that trains in ``run``; it returns what was printed."""

    def train(data: str, *arguments: str) -> str:
        sizes = tiny(
            data, inverse_dynamics_steps=2, steps=2, log_interval=1, eval_interval=2,
            eval_episodes=2, checkpoint_interval=2,
        )  # fmt: skip
        code, output = run(tmp_path, "train", *sizes, "hydra.run.dir=run", *arguments)
        assert code == 0, output
        return output

    return train


def test_a_recorded_ant_is_trained_on(train, tmp_path):
    ant, log = "env=antmaze-umaze", tmp_path / "ant.npz"
    collect.main(composed("collect", ant, f"path={log}", "episodes=3"))
    printed = train("file", ant, f"data.path={log}", "preset=antmaze")
    for word in ("Warning", "WARN", "Traceback", "Adroit"):
        assert word not in printed
    last = json.loads((tmp_path / "run" / "returns.json").read_text())["last"]
    assert last["score"] == 100 * np.mean(last["returns"])
    assert max(last["lengths"]) <= 700


def test_a_point_is_trained_and_disturbed(train, tmp_path):
    train("diverse", "env=pointmaze-umaze", "preset=pointmaze")
    folder = tmp_path / "run"

    def disturb(suite: str) -> None:
        given = f"suite={suite}", f"checkpoint={folder}", "episodes=2", "last=1"
        evaluate.main(composed("evaluate", *given, "progress=false"))

    disturb("torque")
    results = json.loads((folder / "robustness-torque.json").read_text())
    levels = results["evaluations"][0]["levels"]
    names = [f"torque-{steps}" for steps in (2, 5, 10, 15, 20)]
    assert [level["name"] for level in levels] == names
    for level in levels:
        assert set(level["scores"]) <= {0.0, 100.0}
    message = "no disturbance of suite=dynamics is possible, .*PointMaze_UMaze-v3"
    with pytest.raises(ValueError, match=message):
        disturb("dynamics")
