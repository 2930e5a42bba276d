"""What ``torchrl_osr.lab.data`` exports, with and without the extras."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT_EXTRAS = """
import sys
for name in ("gymnasium", "mujoco", "tqdm", "platformdirs"):
    sys.modules[name] = None
from torchrl_osr.lab.data import load_behavior_policy, normalized_score
from torchrl_osr.lab.data import make_replay_buffer, check_dataset
for name in ("load_local_dataset", "collect_quality", "make_environment"):
    try:
        exec(f"from torchrl_osr.lab.data import {name}")
    except ImportError as error:
        assert "pip install torchrl-osr[train]" in str(error), error
    else:
        raise AssertionError(name)
"""


def test_the_rest_works_without_the_examples_extra():
    completed = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
    )
    assert completed.returncode == 0, completed.stderr


def test_public_names_exist():
    import torchrl_osr.lab.data

    assert all(
        hasattr(torchrl_osr.lab.data, name) for name in torchrl_osr.lab.data.__all__
    )
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        torchrl_osr.lab.data.missing  # noqa: B018
