"""The mazes as a user runs them: an ant's log, a point of our own, disturbances."""

from __future__ import annotations

import json

import numpy as np
import pytest
from composed import composed, evaluating, trained

from torchrl_osr.lab.cli import collect
from torchrl_osr.lab.run.evaluate import evaluate_run


def test_a_recorded_ant_is_trained_on(run, tiny, tmp_path):
    ant, log = "env=antmaze-umaze", tmp_path / "ant.npz"
    collect.main(composed("collect", ant, f"path={log}", "episodes=3"))
    given = [*tiny("file"), ant, f"data.path={log}", "preset=antmaze"]
    printed = run(tmp_path, "train", *given, "hydra.run.dir=run")
    for word in ("Warning", "WARN", "Traceback", "Adroit"):
        assert word not in printed
    last = json.loads((tmp_path / "run" / "returns.json").read_text())["last"]
    assert last["score"] == 100 * np.mean(last["returns"])
    assert max(last["lengths"]) <= 700


def test_a_point_is_trained_and_disturbed(tmp_path):
    given = "data=diverse", "env=pointmaze-umaze", "preset=pointmaze"
    folder = trained(tmp_path / "run", *given)

    given = f"checkpoint={folder}", "episodes=2", "last=1"
    _, results = evaluate_run(evaluating("suite=torque", *given))
    levels = results["evaluations"][0]["levels"]
    names = [f"torque-{steps}" for steps in (2, 5, 10, 15, 20)]
    assert [level["name"] for level in levels] == names
    for level in levels:
        assert set(level["scores"]) <= {0.0, 100.0}
    message = "no disturbance of suite=dynamics is possible, .*PointMaze_UMaze-v3"
    with pytest.raises(ValueError, match=message):
        evaluate_run(evaluating("suite=dynamics", *given))
