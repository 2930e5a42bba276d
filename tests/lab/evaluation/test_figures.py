"""Figures are drawn, from scalars as logged."""

from __future__ import annotations

import pytest
from torchrl.record.loggers import CSVLogger

from torchrl_osr.lab.evaluation.figures import learning_curve, read_scalars

PNG = b"\x89PNG"


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


def test_scalars_are_read_as_logged_and_the_later_row_counts(tmp_path):
    for values in ({1: 5.0, 2: 6.0, 3: 7.0}, {2: 6.5, 3: 7.5}):  # killed, then resumed
        logger = CSVLogger("csv", log_dir=str(tmp_path))
        for step, value in values.items():
            logger.log_scalar("policy/loss_x", value, step=step)
    scalars = read_scalars(tmp_path / "csv" / "scalars" / "policy")
    assert scalars == {"loss_x": [(1, 5.0), (2, 6.5), (3, 7.5)]}
