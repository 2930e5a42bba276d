"""Every kind of logger leaves numbers that can be read back."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_osr.lab.evaluation.training_summary import read_scalars
from torchrl_osr.lab.run import loggers
from torchrl_osr.lab.run.loggers import log_outcome, make_loggers

CONFIG = {"seed": 3, "loss": {"recovery_weight": 0.5, "kind": None}}
ROWS = {
    "last": {"step": 7, "score": 30.0, "score_low": 20.0, "score_high": 40.0},
    "best": {"step": 5, "return": 50.0, "return_low": 45.0, "return_high": 55.0},
}


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


class FakeRun:
    """Stands for ``wandb.Run``; keeps what it is given."""

    def __init__(self, **options):
        self.options, self.logged, self.finished = options, {}, False
        self.config, self.summary = {}, {}

    def define_metric(self, *names, **options): ...

    def log(self, values, **options):
        self.logged |= values

    def finish(self):
        self.finished = True


@pytest.fixture
def wandb_runs(monkeypatch):
    """W&B's package, replaced by one that keeps its runs."""
    runs = []

    def init(**options):
        runs.append(FakeRun(**options))
        return runs[-1]

    fake = SimpleNamespace(init=init, Image=lambda path: path)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr("torchrl.record.loggers.wandb._has_wandb", True)
    monkeypatch.setattr(loggers, "find_spec", lambda _: True)
    # It is handed what update() of a real configuration takes besides.
    monkeypatch.setattr("torchrl.record.loggers.wandb._collect_env_metadata", dict)
    return runs


def test_wandb_knows_the_run_and_keeps_its_figure_and_results(tmp_path, wandb_runs):
    about = {"name": "hopper osr seed3", "group": "hopper osr", "tags": ["osr"],
             "config": CONFIG}  # fmt: skip
    made = make_loggers("wandb", tmp_path, project="mine", mode="offline", **about)
    made[1].log_scalar("policy/score", 3.0, step=7)
    log_outcome(made, ROWS, {"curve": tmp_path / "curve.png"})
    (run,) = wandb_runs
    assert about.items() <= run.options.items()
    assert (run.options["project"], run.options["mode"]) == ("mine", "offline")
    assert run.logged["policy/score"] == 3.0
    assert run.logged["curve"] == str(tmp_path / "curve.png")
    assert run.summary == {"last_score": 30.0, "best_return": 50.0}
    assert run.finished
    make_loggers("wandb", tmp_path)
    make_loggers("wandb", tmp_path / "other")
    ids = [each.options["id"] for each in wandb_runs]
    assert ids[0] == ids[1] != ids[2], "a continued run is the same run"


def test_unknown_kind_lists_what_exists(tmp_path):
    with pytest.raises(
        ValueError, match="logger.kind must be one of .*tensorboard.*wandb"
    ):
        make_loggers("mlflow", tmp_path)


def test_missing_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers, "find_spec", lambda _: None)
    with pytest.raises(ImportError, match=r"torchrl-osr\[wandb\]"):
        make_loggers("wandb", tmp_path)
