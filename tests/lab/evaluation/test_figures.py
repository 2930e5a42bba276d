"""Scalars are read as logged; runs draw the figures."""

from __future__ import annotations

from torchrl.record.loggers import CSVLogger

from torchrl_osr.lab.evaluation import figures
from torchrl_osr.lab.evaluation.figures import read_scalars


def test_scalars_are_read_as_logged_and_the_later_row_counts(tmp_path):
    for values in ({1: 5.0, 2: 6.0, 3: 7.0}, {2: 6.5, 3: 7.5}):  # killed, then resumed
        logger = CSVLogger("csv", log_dir=str(tmp_path))
        for step, value in values.items():
            logger.log_scalar("policy/loss_x", value, step=step)
    scalars = read_scalars(tmp_path / "csv" / "scalars" / "policy")
    assert scalars == {"loss_x": [(1, 5.0), (2, 6.5), (3, 7.5)]}


def test_losses_without_a_panel_of_their_own_are_drawn(monkeypatch):
    drawn = []
    monkeypatch.setattr(
        figures, "save_figure", lambda figure, path: drawn.append(figure)
    )
    scalars = {"loss_bc": [(1, 5.0), (2, 6.5)], "log_prob": [(1, 0.0), (2, 1.0)]}
    figures.learning_curve([], scalars, "", title="", data_mean=None)
    assert [axes.get_title() for axes in drawn[0].axes] == ["loss_bc"]
