"""The example that draws three controllers after the same push."""

from __future__ import annotations

from importlib import import_module

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from matplotlib.image import imread
from processes import EXAMPLES
from untrained_run import make_run


def test_draws_three_controllers(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES)
    film_recovery = import_module("film_recovery")
    # What is drawn needs OpenGL; who falls when does not.
    picture = np.zeros((8, 8, 3), np.uint8)
    monkeypatch.setattr(MujocoEnv, "render", lambda _: picture)
    make_run(tmp_path / "run", "env=hopper")
    film_recovery.main([str(tmp_path / "run"), "--nearest"])
    printed = capsys.readouterr().out
    for name in ("behaviour", "inverse_dynamics", "osr"):
        assert name in printed
    assert imread(tmp_path / "run" / "recovery.png").shape[1] > 1000
