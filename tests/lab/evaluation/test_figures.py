"""Figures are drawn."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_osr.lab.evaluation.figures import (
    data_figure,
    learning_curve,
    robustness_figure,
)

PNG = b"\x89PNG"


def test_robustness_figure_is_drawn(tmp_path):
    numbers = {"return": 5, "return_low": 4, "return_high": 7, "clean_return": 9}
    summary = [{"name": "a", "disturbed_share": 1} | numbers]
    summary.append({"name": "b", "disturbed_share": 0} | numbers)
    path = tmp_path / "figure.png"
    robustness_figure(summary, path, title="hopper")
    assert path.read_bytes().startswith(PNG)


@pytest.mark.parametrize("evaluations", [0, 3])
def test_learning_curve_is_drawn(tmp_path, evaluations):
    history = [
        {"step": step, "score": 1, "score_low": 0, "score_high": 2}
        for step in range(evaluations)
    ]
    scalars = {"loss_cql": [(1, 2.0), (2, 3.0)]}
    path = tmp_path / "curve.png"
    learning_curve(history, scalars, path, title="osr", data_mean=5.0)
    assert path.read_bytes().startswith(PNG)


def test_data_figure_is_drawn_although_entries_are_many(tmp_path):
    rows = {"observation": torch.randn(50, 40), "action": torch.rand(50, 2) * 2 - 1}
    after = {"reward": torch.randn(50, 1), "observation": torch.randn(50, 40)}
    names = {"observation": [f"s{i}" for i in range(40)], "action": ["a", "b"]}
    path = tmp_path / "data.png"
    data = TensorDict(rows | {"next": after}, [50])
    data_figure(data, {"episode_returns": [1.0]}, names, path, title="log")
    assert path.read_bytes().startswith(PNG)
