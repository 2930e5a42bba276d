"""Every kind of logger leaves numbers that can be read back."""

from __future__ import annotations

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_osr.evaluation import read_scalars
from torchrl_osr.experiment import loggers
from torchrl_osr.experiment.loggers import make_loggers


def test_csv_files_are_written_whatever_the_kind(tmp_path):
    for kind in ("csv", "tensorboard"):
        for logger in make_loggers(kind, tmp_path / kind):
            logger.log_scalar("policy/score", 3.0, step=7)
        scalars = read_scalars(tmp_path / kind / "csv" / "scalars" / "policy")
        assert scalars == {"score": [(7, 3.0)]}


def test_tensorboard_reads_the_events(tmp_path):
    for logger in make_loggers("tensorboard", tmp_path):
        logger.log_scalar("policy/score", 3.0, step=7)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    logger.experiment.flush()
    events.Reload()
    (event,) = events.Scalars("policy/score")
    assert (event.step, event.value) == (7, 3.0)


def test_unknown_kind_lists_what_exists(tmp_path):
    with pytest.raises(
        ValueError, match="logger.kind must be one of .*tensorboard.*wandb"
    ):
        make_loggers("mlflow", tmp_path)


def test_missing_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers, "find_spec", lambda _: None)
    with pytest.raises(ImportError, match=r"torchrl-osr\[wandb\]"):
        make_loggers("wandb", tmp_path)
