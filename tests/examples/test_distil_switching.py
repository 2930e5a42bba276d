"""The example that makes one network of a choice among policies."""

from __future__ import annotations

from importlib import import_module

import gymnasium
import numpy as np
import pytest
from processes import EXAMPLES
from untrained_run import make_run

from torchrl_osr.lab.dynamics import Body, DynamicsEnsemble
from torchrl_osr.lab.dynamics.training import FILE, write_dynamics
from torchrl_osr.policy import load_policy


@pytest.mark.usefixtures("own_cache")
def test_one_network_imitates_the_choice(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES)
    runs = [tmp_path / "first", tmp_path / "second"]
    for run in runs:
        make_run(run, "loss=td3_bc", "data=random", "data.num_transitions=600")
    model = DynamicsEnsemble(11, 3, num_networks=1, num_elites=1, num_cells=[4])
    model.body = Body(gymnasium.make("Hopper-v5").unwrapped.fullpath, 4)
    write_dynamics(runs[0] / FILE, model)
    sizes = ["--starts", "60", "--steps", "3", "--horizon", "2", "--updates", "2"]
    made = tmp_path / "made"
    main = import_module("distil_switching").main
    main([*map(str, runs), "--output", str(made), *sizes])
    assert "round 1: " in capsys.readouterr().out
    rows = [np.load(made / f"round{n}" / f"round{n}.npz") for n in range(2)]
    assert len(rows[1]["action"]) > len(rows[0]["action"]) >= 5
    assert load_policy(made / "round1").act(np.zeros(11)).shape == (3,)
