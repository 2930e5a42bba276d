"""SIGTERM: the run stops at its next update, is saved, and goes on to the same bits."""

from __future__ import annotations

import os
import pickle
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from torchrl.record.loggers import CSVLogger

from torchrl_osr.evaluation import read_scalars
from torchrl_osr.experiment import run_folder
from torchrl_osr.trainers import train_together
from torchrl_osr.trainers.preemption import Preempted, sigterm_noted
from torchrl_osr.trainers.processes import train_in_processes

STEPS = 12


@pytest.fixture(autouse=True)
def _handler_is_put_back():
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    yield
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def terminate() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def make(runs, folder: Path, **options):
    logger = CSVLogger("csv", log_dir=str(folder))
    return runs.make(folder / "run", loggers=[logger], **options)


def stop_in(trainer, step: int) -> None:
    """Have the process asked to end in the middle of an update."""

    def ask(batch):
        if trainer.step == step:
            terminate()
        return batch

    trainer.register_op("process_optim_batch", ask)


def assert_same_run(runs, mine, theirs) -> None:
    """Compare networks, optimizer, generators, checkpoints and the steps of the log."""
    for ours, wanted in zip(runs.state(mine), runs.state(theirs), strict=True):
        assert torch.equal(ours, wanted)
    folders = [each.rotation.directory for each in (mine, theirs)]
    here, there = ({path.name for path in folder.iterdir()} for folder in folders)
    assert here == there
    logs = [read_scalars(each.parent / "csv/scalars/train") for each in folders]
    here, there = ([step for step, _ in log["loss_qvalue"]] for log in logs)
    assert here == there


@pytest.mark.parametrize("steps", [[1], [5], [6], [11], [2, 3, 9], [7, 8]])
def test_preempted_run_ends_as_an_undisturbed_one(tmp_path, runs, steps):
    undisturbed = make(runs, tmp_path / "undisturbed", checkpoint_interval=5)
    undisturbed.train()
    for step in steps:
        trainer = make(runs, tmp_path / "run", checkpoint_interval=5)
        stop_in(trainer, step)
        with pytest.raises(Preempted, match=f"at step {step}; .*{step:012d}") as raised:
            trainer.train()
        assert raised.value.code == 75
        # What is due stays; of those out of turn only the newest does.
        names = {path.stem for path in trainer.rotation.directory.glob("check*")}
        due = {each for each in (5, 10) if each <= step}
        assert names == {f"checkpoint-{each:012d}" for each in due | {step}}
    resumed = make(runs, tmp_path / "run", checkpoint_interval=5)
    resumed.train()
    assert_same_run(runs, resumed, undisturbed)


@pytest.mark.parametrize("step", [1, 2, 3, 4, 5, 8, 11])
def test_captured_run_stops_between_two_replays(
    tmp_path, runs, graphs, monkeypatch, step
):
    """Also where the signal comes in the warm-up, or during the capture."""
    undisturbed = make(runs, tmp_path / "undisturbed", cudagraph=True)
    undisturbed.train()
    trainer = make(runs, tmp_path / "run", cudagraph=True)
    stop_in(trainer, step)
    replay, calls = type(graphs[0]).replay, []

    def asked(graph):
        replay(graph)
        calls.append(1)
        if len(calls) + 3 == step:
            terminate()

    with monkeypatch.context() as patch:
        patch.setattr(type(graphs[0]), "replay", asked)
        with pytest.raises(Preempted, match=f"at step {step};"):
            trainer.train()
    assert trainer.captured._calls == step
    resumed = make(runs, tmp_path / "run", cudagraph=True)
    resumed.train()
    assert_same_run(runs, resumed, undisturbed)


def test_evaluation_is_finished_first(tmp_path, runs):
    def evaluate():
        terminate()
        return {"score": 1.0}

    trainer = make(runs, tmp_path, evaluate=evaluate)
    with pytest.raises(Preempted, match="at step 6"):
        trainer.train()
    trainer = make(runs, tmp_path, evaluate=evaluate)
    with pytest.raises(Preempted, match=f"at step {STEPS}"):
        trainer.train()
    finished = make(runs, tmp_path, evaluate=pytest.fail)
    finished.train()
    assert [row["step"] for row in finished.history] == [6, STEPS]


def test_signal_before_the_first_update_saves_nothing(tmp_path, runs):
    trainer = make(runs, tmp_path)
    trainer.register_op("pre_optim_steps", terminate)
    with pytest.raises(Preempted, match="at step 0; the last checkpoint is None"):
        trainer.train()
    assert not list(trainer.rotation.directory.iterdir())


def test_updates_are_settled_before_they_are_saved(tmp_path, runs):
    """A skipped one is counted; of a bad one no checkpoint is written."""

    def spoiled(mode):
        trainer = make(runs, tmp_path / mode, nonfinite=mode)
        original = trainer.loss_module.forward

        def forward(batch):
            losses = original(batch)
            return losses * torch.nan if trainer.step == 2 else losses

        trainer.loss_module.forward = forward
        stop_in(trainer, 2)
        return trainer

    with pytest.raises(Preempted):
        spoiled("skip").train()
    resumed = make(runs, tmp_path / "skip", nonfinite="skip")
    resumed.resume()
    assert (resumed.step, resumed.guard.skipped) == (2, 1)
    with pytest.raises(FloatingPointError):
        spoiled("stop").train()


def test_handlers_of_others_and_other_threads_are_left_alone(tmp_path, runs):
    def of_submitit(number, frame): ...

    signal.signal(signal.SIGTERM, of_submitit)
    try:
        with sigterm_noted():
            assert signal.getsignal(signal.SIGTERM) is of_submitit
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    trainer = make(runs, tmp_path)
    handlers = []
    trainer.register_op(
        "post_optim", lambda: handlers.append(signal.getsignal(signal.SIGTERM))
    )
    thread = threading.Thread(target=trainer.train)
    thread.start()
    thread.join()
    assert handlers == [signal.SIG_DFL] * STEPS


def test_reason_reaches_the_status_and_another_process(tmp_path):
    error = Preempted("saved at step 3")
    with pytest.raises(Preempted), run_folder.status(tmp_path):
        raise error
    text = (tmp_path / "status.json").read_text()
    assert '"preempted"' in text
    assert "saved at step 3" in text
    again = pickle.loads(pickle.dumps(error))
    assert (again.code, again.reason) == (75, error.reason)


def test_population_is_saved_and_continued(tmp_path, runs):
    def members(name):
        for index in range(2):
            torch.manual_seed(index)
            yield runs.make(tmp_path / name / str(index), seed=index)

    def run(trainer):
        yield trainer
        return trainer

    undisturbed = train_together([run(each) for each in members("undisturbed")])
    stopped = list(members("all"))
    stop_in(stopped[1], 5)
    reasons = []

    def noted(trainer):
        try:
            yield trainer
        except Preempted as error:
            reasons.append(error.reason)
            raise

    with pytest.raises(Preempted, match=r"0/checkpoint-0+5\..*1/checkpoint-0+5\."):
        train_together([noted(each) for each in stopped])
    assert len(reasons) == 2
    resumed = train_together([run(each) for each in members("all")])
    for mine, theirs in zip(resumed, undisturbed, strict=True):
        *ours, _ = runs.state(mine)
        *wanted, _ = runs.state(theirs)
        assert all(torch.equal(a, b) for a, b in zip(ours, wanted, strict=True))


CHILD = """
import pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1][8:-1])
signal.signal(signal.SIGTERM, lambda *_: sys.exit(int(folder.name)))
(folder / "ready").touch()
time.sleep(60)
"""


@pytest.mark.parametrize(
    ("codes", "error"), [((75, 0, 75), Preempted), ((75, 3, 0), RuntimeError)]
)
def test_processes_are_told_and_waited_for(tmp_path, codes, error):
    script = tmp_path / "script.py"
    script.write_text(CHILD, encoding="utf-8")
    folders = [tmp_path / str(index) / str(code) for index, code in enumerate(codes)]
    for each in folders:
        each.mkdir(parents=True)

    def terminate_when_ready():
        while not all((each / "ready").exists() for each in folders[:2]):
            time.sleep(0.01)
        terminate()

    thread = threading.Thread(target=terminate_when_ready)
    thread.start()
    with pytest.raises(error):
        train_in_processes(script, folders, 2)
    thread.join()
    assert not (folders[2] / "ready").exists(), "started after the word to end"
