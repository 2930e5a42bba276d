"""Signals: the run stops at its next update, is saved, and goes on to the same bits."""

from __future__ import annotations

import os
import pickle
import signal
import threading

import pytest
import torch
from objectives.losses import assert_same_bits
from tensordict import TensorDict

from torchrl_osr.trainers import Interrupted
from torchrl_osr.trainers.interruption import EXIT_CODES, interrupts_kept, signals_noted

STEPS = 20


@pytest.fixture(autouse=True)
def _handlers_are_put_back():
    before = [signal.getsignal(number) for number in EXIT_CODES]
    yield
    assert [signal.getsignal(number) for number in EXIT_CODES] == before


def stop_in(trainer, step: int, number: int = signal.SIGTERM) -> None:
    """Send the process a signal in the middle of an update."""

    def send(batch):
        if trainer.step == step:
            os.kill(os.getpid(), number)
        return batch

    trainer.register_op("process_optim_batch", send)


def files(trainer) -> set[str]:
    return {path.name for path in trainer.checkpoints.folder.glob("checkpoint-*")}


@pytest.mark.parametrize("steps", [[1], [5], [19], [2, 3, 9], [7, 8]])
def test_interrupted_run_ends_alike(tmp_path, make, state, logger, whole, steps):
    for step in steps:
        trainer = make(tmp_path / "run", loggers=[logger])
        stop_in(trainer, step)
        with pytest.raises(Interrupted, match=f"at step {step}; .*{step:012d}"):
            trainer.train()
        # Regular ones stay; of the extra ones only the newest does.
        regular = [each for each in (5, 10, 15) if each <= step][-2:]
        names = {f"checkpoint-{each:012d}.torchrl" for each in {*regular, step}}
        assert files(trainer) == names
    resumed = make(tmp_path / "run", loggers=[logger])
    resumed.train()
    assert_same_bits(state(resumed), state(whole))
    assert [row["step"] for row in resumed.history] == [0, 5, 10, 15, STEPS]
    assert files(resumed) == files(whole)
    logged = [step for name, step, _ in logger.numbers if name == "train/loss_qvalue"]
    assert logged == [3, 5, 6, 9, 10, 12, 15, 18, 20]


@pytest.mark.parametrize(("name", "code"), [("TERM", 75), ("HUP", 75), ("INT", 130)])
def test_each_signal_has_its_exit_code(tmp_path, make, caplog, name, code):
    trainer = make(tmp_path)
    stop_in(trainer, 3, signal.Signals[f"SIG{name}"])
    with pytest.raises(Interrupted, match=f"stopped by SIG{name} at step 3") as raised:
        trainer.train()
    assert raised.value.code == code
    assert raised.value.reason in caplog.text
    again = pickle.loads(pickle.dumps(raised.value))  # from a worker process
    assert (again.code, again.reason) == (code, raised.value.reason)


def test_second_ctrl_c_interrupts_at_once(tmp_path, make, capfd):
    def evaluate():
        os.kill(os.getpid(), signal.SIGINT)
        assert "Ctrl-C again stops at once" in capfd.readouterr().err
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("not reached")

    with pytest.raises(KeyboardInterrupt):
        make(tmp_path, evaluate=evaluate).train()


def test_evaluation_is_finished_first(tmp_path, make):
    def evaluate():
        if trainer.step == stop:
            os.kill(os.getpid(), signal.SIGTERM)
        return {"score": 1.0}

    # Before the first update there is nothing to continue from.
    for stop, end in ((0, "; the last checkpoint is None"), (5, ""), (STEPS, "")):
        trainer = make(tmp_path, evaluate=evaluate)
        with pytest.raises(Interrupted, match=f"at step {stop}{end}"):
            trainer.train()
    stop, trainer = None, make(tmp_path, evaluate=evaluate)
    trainer.train()
    assert [row["step"] for row in trainer.history] == [0, 5, 10, 15, STEPS]


def test_handlers_of_others_and_other_threads_are_left_alone(tmp_path, make):
    def of_submitit(number, frame): ...

    signal.signal(signal.SIGTERM, of_submitit)
    try:
        with signals_noted():
            assert signal.getsignal(signal.SIGTERM) is of_submitit
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    trainer, handlers = make(tmp_path), []
    trainer.register_op(
        "post_optim", lambda: handlers.append(signal.getsignal(signal.SIGTERM))
    )
    thread = threading.Thread(target=trainer.train)
    thread.start()
    thread.join()
    assert handlers == [signal.SIG_DFL] * STEPS


@pytest.mark.parametrize("interrupt", [Interrupted("SIGTERM", 75), KeyboardInterrupt()])
def test_an_interrupt_inside_tensordict_stays_one(interrupt):
    rows = TensorDict({"state": torch.zeros(3)}, [3])
    expected = pytest.raises(type(interrupt))
    with expected as caught, interrupts_kept(), rows.view(3, 1):
        raise interrupt
    assert caught.value is interrupt
    with pytest.raises(RuntimeError, match="of our own"), interrupts_kept():
        raise RuntimeError("of our own")
    # tensordict 0.14.3; once this fails, interrupts_kept can go.
    with pytest.raises(RuntimeError, match="boolean"), rows.view(3, 1):
        raise interrupt
