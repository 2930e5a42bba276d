"""The offline trainer: counts, logs, checkpoints, and resuming to the same bits."""

from __future__ import annotations

import json
import math
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from objectives.losses import Networks, assert_same_bits, make_loss, update_targets
from torchrl.checkpoint import CheckpointError
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.scheduler import LinearScheduler
from torchrl.objectives import HardUpdate, SACLoss, TD3BCLoss
from torchrl.record.loggers import CSVLogger

from torchrl_osr import StatePerturbation
from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import OfflineTrainer, divergence_warning

STEPS = 20


def stop_at(trainer: OfflineTrainer, step: int) -> None:
    """Run ``trainer`` and break it off in the middle of an update, as a kill does."""

    def kill(batch):
        if trainer.step > step:
            raise RuntimeError("killed")

    trainer.register_op("process_optim_batch", kill)
    with pytest.raises(RuntimeError, match="killed"):
        trainer.train()


def steps_of(trainer: OfflineTrainer) -> list[int]:
    return [row["step"] for row in trainer.history]


def manifest_of(path: Path) -> dict:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("manifest.json"))


def test_updates_evaluations_and_checkpoints_come_when_due(make, whole):
    assert whole.step == whole.collected_frames == STEPS
    steps = {int(row["step"]) for row in whole.optimizer.state.values()}
    assert steps == {STEPS}
    assert steps_of(whole) == [0, 5, 10, 15, 20]
    checkpoints = whole.checkpoints
    names = [f"checkpoint-0000000000{step}.torchrl" for step in (15, 20)]
    there = sorted(path.name for path in checkpoints.folder.iterdir())
    assert there == ["best.torchrl", *names]
    # Not the data set.
    assert set(manifest_of(checkpoints.latest())["components"]) == {
        "global_rng", "history", "loss_module", "optimizer", "perturbation",
        "progress", "sampler",
    }  # fmt: skip
    again = make(checkpoints.folder, evaluate=pytest.fail)
    again.train()  # returns at once
    assert again.history == whole.history


# -- resume ---------------------------------------------------------------------------


@pytest.mark.parametrize("kills", [[3], [12, 3], [5, 5, 9]])
@pytest.mark.parametrize("trace", [False, True])
def test_killed_run_ends_in_the_same_bits(tmp_path, make, state, whole, kills, trace):
    wanted, step = state(whole), 0
    for more in kills:
        stop_at(make(tmp_path / "run"), step := step + more)
    resumed = make(tmp_path / "run", trace=trace, warm_up=1)
    resumed.train()
    assert_same_bits(state(resumed), wanted)
    assert steps_of(resumed) == steps_of(whole)


def assert_resumes(make_run, state, tmp_path) -> OfflineTrainer:
    """Compare a killed run with a whole one, which is returned."""
    whole = make_run(tmp_path / "whole")
    whole.train()
    stop_at(make_run(tmp_path / "run"), 7)
    resumed = make_run(tmp_path / "run")
    resumed.train()
    assert_same_bits(state(resumed), state(whole))
    return whole


MADE = {
    "TorchRL's": lambda of: SACLoss(of.actor, of.critics, target_entropy=-2.0),
    "metrics of rows": lambda of: TD3BCLoss(of.delta, of.critics, bounds=(-1.0, 1.0)),
    "ours": lambda of: make_loss("model", of, states="clean"),
}


@pytest.mark.parametrize("made", MADE)
def test_sampler_without_replacement_ends_its_epoch(tmp_path, state, transitions, made):
    def make_run(folder):
        loss = update_targets(MADE[made](Networks()).float())
        buffer = make_replay_buffer(transitions(64), batch_size=8, seed=0)
        buffer.set_sampler(SamplerWithoutReplacement())
        adam, (first, *_) = torch.optim.Adam(loss.parameters()), loss.parameters()
        update = FastUpdate(loss, adam, policy_delay=2, policy_params=[first])
        return OfflineTrainer(
            update, buffer, STEPS, folder, checkpoint_interval=5, progress=False
        )

    assert assert_resumes(make_run, state, tmp_path).best() is None


@pytest.mark.parametrize("trace", [False, True])
def test_priorities_follow_errors_and_are_restored(tmp_path, state, transitions, trace):
    def make_run(folder, name="osr"):
        loss = make_loss(name).float()
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(64), batch_size=8,
            sampler=PrioritizedSampler(64, alpha=0.7, beta=0.5),
            priority_key="td_error", transform=StatePerturbation(0.1, seed=0),
        )  # fmt: skip
        buffer.extend(transitions(64))
        optimizer = torch.optim.Adam(loss.parameters())
        every = {"value_network_update_interval": 4}
        updater = HardUpdate(loss, **every) if name == "osr" else None
        update = FastUpdate(loss, optimizer, updater, trace=trace, warm_up=2)
        alpha, beta = (
            LinearScheduler(buffer, name, final_value=1.0, num_steps=STEPS)
            for name in ("alpha", "beta")
        )
        return OfflineTrainer(
            update, buffer, STEPS, folder, checkpoint_interval=5, progress=False,
            components={"perturbation": buffer.transform[-1], "a": alpha, "b": beta},
            hooks=[("post_optim", alpha.step), ("post_optim", beta.step)],
        )  # fmt: skip

    rows, before = torch.arange(64), make_run(tmp_path).buffer.sampler._sum_tree
    after = assert_resumes(make_run, state, tmp_path).buffer.sampler._sum_tree
    assert (before[rows] != after[rows]).sum() > 32
    cloning = make_run(tmp_path / "bc", "bc")  # which computes no priorities
    cloning.buffer.update_priority(rows, rows + 1.0)
    cloning.train()
    given = cloning.buffer.sampler._sum_tree[rows]  # to the power of 1, at last
    assert torch.allclose(given, rows + 1.0)


@pytest.mark.parametrize("step", [7, 20])
def test_longer_run_equals_one_that_was_so_from_the_start(tmp_path, make, whole, step):
    """Killed before, or finished; other intervals change no update."""
    short = {"total_steps": 10, "eval_interval": 2, "checkpoint_interval": 3}
    if step < 10:
        stop_at(make(tmp_path, **short), step)
    else:
        make(tmp_path, **short).train()
    longer = make(tmp_path)
    longer.train()
    networks = longer.loss_module.state_dict(), whole.loss_module.state_dict()
    assert_same_bits(*(each.values() for each in networks))
    assert longer.history[-1]["step"] == STEPS
    with pytest.raises(ValueError, match="is at step 20, beyond the 19 steps"):
        make(tmp_path, total_steps=19).train()


# -- evaluations ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("best", "scores", "step"),
    [
        ("max", [0.0, 2.0, 5.0, 1.0, 5.0], 10),
        ("min", [0.0, 2.0, 5.0, 1.0, 5.0], 15),  # not the untrained one
        ("max", [1.0, *[math.nan] * 4], 0),  # which counts only by itself
    ],
)
def test_best_checkpoint_is_of_the_best_evaluation(tmp_path, make, best, scores, step):
    left = iter(map(np.float32, scores))
    trainer = make(tmp_path, best=best, evaluate=lambda: {"score": next(left)})
    trainer.train()
    assert trainer.best() == {"step": step, "score": scores[step // 5]}
    manifest = manifest_of(trainer.checkpoints.best_path)
    assert manifest["metadata"]["step"] == step
    assert set(manifest["components"]) == {"loss_module", "perturbation"}


def test_evaluation_that_kills_the_process_loses_no_step(tmp_path, make, state, whole):
    def evaluate():
        if trainer.step == 10:
            raise KeyboardInterrupt
        return {"score": trainer.step / 5, "raw": [1]}

    trainer = make(tmp_path, evaluate=evaluate)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert trainer.checkpoints.latest().name == "checkpoint-000000000010.torchrl"
    trainer = make(tmp_path, evaluate=lambda: {"score": trainer.step / 5, "raw": [1]})
    trainer.train()
    assert trainer.history == whole.history
    assert_same_bits(state(trainer), state(whole))


def test_a_failing_evaluation_costs_itself_alone(tmp_path, make, whole):
    def evaluate():
        if trainer.step == 10:
            raise RuntimeError("motor driver lost connection")
        return {"score": trainer.step / 5, "step": 1} if trainer.step != 15 else {}

    trainer = make(tmp_path, evaluate=evaluate)
    trainer.train()
    assert list(trainer.failed_evaluations) == [10, 15]
    assert steps_of(trainer) == [0, 5, 20]
    networks = (each.loss_module.state_dict() for each in (trainer, whole))
    assert_same_bits(*(each.values() for each in networks))


# -- checkpoints ----------------------------------------------------------------------


def corrupt(path: Path) -> None:
    """Flip one bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


@pytest.mark.parametrize("damage", [corrupt, truncate])
def test_a_damaged_newest_checkpoint_is_passed_over(
    tmp_path, make, state, whole, damage, caplog
):
    wanted = state(whole)
    folder = shutil.copytree(whole.checkpoints.folder, tmp_path / "run")
    damage(folder / "checkpoint-000000000020.torchrl")
    resumed = make(folder)
    assert resumed.resume().name == "checkpoint-000000000015.torchrl"
    assert "is damaged" in caplog.text
    assert resumed.checkpoints.latest().name == "checkpoint-000000000015.torchrl"
    assert (folder / "checkpoint-000000000020.damaged").exists()
    resumed.train()
    assert_same_bits(state(resumed), wanted)
    for path in folder.glob("checkpoint-*"):
        damage(path)
    with pytest.raises(CheckpointError, match="All 2 checkpoints"):
        make(folder).train()


def test_folder_that_is_removed_is_not_made_anew(tmp_path, make):
    folder = tmp_path / "run"
    hooks = [("post_steps", lambda: shutil.rmtree(folder, True))]
    with pytest.raises(FileNotFoundError, match=f"{folder} was removed"):
        make(folder, hooks=hooks).train()
    assert not folder.exists()


# -- logs and hooks -------------------------------------------------------------------


def test_numbers_are_logged_as_means_over_the_interval(tmp_path, make, logger):
    seen = []
    trainer = make(tmp_path, loggers=[logger])
    original = trainer.loss_module.forward
    trainer.loss_module.forward = lambda batch: seen.append(original(batch)) or seen[-1]
    trainer.train()
    scores = [step for name, step, _ in logger.numbers if name == "train/score"]
    assert scores == [0, 5, 10, 15, 20]
    losses = [row[1:] for row in logger.numbers if row[0] == "train/loss_qvalue"]
    steps = [3, 5, 6, 9, 10, 12, 15, 18, 20]
    assert [step for step, _ in losses] == steps
    for start, (end, value) in zip([0, *steps], losses, strict=False):
        mean = torch.stack([row["loss_qvalue"] for row in seen[start:end]]).mean()
        assert value == pytest.approx(mean.item(), rel=1e-5)
    assert "train/raw" not in {name for name, *_ in logger.numbers}


SCORES = {"score": 1, "eval/reward": 2}


@pytest.mark.parametrize(("interval", "evaluated"), [(5, 0), (100, 0), (5, 10)])
def test_killed_run_logs_no_step_twice(tmp_path, make, interval, evaluated):
    """Killed in its last step, some time after its last checkpoint or before any.

    Or killed after an evaluation, before the checkpoint that has the result.
    """

    def make_logged(folder):
        csv = CSVLogger("csv", log_dir=str(tmp_path / folder))
        options = {"checkpoint_interval": interval, "log_interval": 1, "loggers": [csv]}
        return make(tmp_path / folder, **options, evaluate=lambda: SCORES)

    def files(folder):
        return (tmp_path / folder / "csv" / "scalars" / "train").rglob("*.csv")

    def read(folder):
        return {path.parts[-2:]: path.read_text() for path in files(folder)}

    make_logged("undisturbed").train()
    killed = make_logged("killed")
    save = killed.checkpoints.save

    def save_or_die(step):
        if evaluated and killed.history[-1]["step"] == evaluated:
            raise RuntimeError("killed")
        save(step)

    killed.checkpoints.save = save_or_die
    stop_at(killed, 19)
    before = read("killed")
    for number, path in enumerate(files("killed")):  # killed within a line
        path.write_text(path.read_text() + ["6", "60,", "60,0.1"][number % 3])
    make_logged("killed").train()
    assert read("killed") == read("undisturbed") != before


def test_a_fresh_run_keeps_the_rows_of_another(tmp_path, make):
    csv = CSVLogger("csv", log_dir=str(tmp_path))
    path = tmp_path / "csv" / "scalars" / "train" / "loss_qvalue.csv"
    make(tmp_path / "first", loggers=[csv]).train()
    before = path.read_text()
    second = make(tmp_path / "second", loggers=[csv])
    second.resume()
    second.train()
    assert path.read_text().startswith(before)


def test_hooks_run_before_checkpoint_and_evaluation(tmp_path, make):
    order, places = [], (
        "process_optim_batch", "post_optim", "post_optim_log",
        "post_optim_complete_log", "post_steps", "post_steps_log",
    )  # fmt: skip
    hooks = [(name, lambda *_, name=name: order.append(name)) for name in places]
    evaluate = {"evaluate": lambda: order.append("evaluated") or {"score": 0}}
    trainer = make(tmp_path, total_steps=1, hooks=hooks, **evaluate)
    original = trainer.checkpoints.save
    trainer.checkpoints.save = lambda step: (order.append("saved"), original(step))
    trainer.train()
    first, *order = order
    assert first == "evaluated"
    # Saved once more, with the result.
    assert order == [*places[:5], "saved", places[5], "evaluated", "saved"]


@pytest.mark.parametrize("reward", [1e-9, 1e9])
def test_values_that_diverge_are_warned_of_once(tmp_path, make, caplog, reward):
    make(tmp_path, hooks=[divergence_warning(reward, 0.5)]).train()
    said = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert len(said) == (2 if reward < 1 else 0)
    for message in said:
        assert "value is" in message
        assert "a magnitude above 2e-08 means" in message  # ten times 1e-9 / (1 - 0.5)


@pytest.mark.parametrize("step", [1, 7])
@pytest.mark.parametrize("trace", [False, True])
def test_run_stops_before_a_step_that_is_not_finite(tmp_path, make, state, step, trace):
    def spoil(batch):
        if trainer.step == step:
            batch["next", "reward"].fill_(math.nan)

    hooks, folder = [("process_optim_batch", spoil)], tmp_path / "run"
    trainer = make(folder, hooks=hooks, trace=trace, warm_up=1)
    match = f"train: step {step}: not finite: losses .*loss_qvalue.*; gradients qvalue"
    with pytest.raises(FloatingPointError, match=match):
        trainer.train()
    if step == 1:
        with pytest.raises(RuntimeError, match="no checkpoint yet: build networks"):
            trainer.train()
    # The networks are those of the updates before.
    before = make(tmp_path / "before", total_steps=max(step - 1, 1))
    if step > 1:
        before.train()
    networks = (each.loss_module.state_dict() for each in (trainer, before))
    assert_same_bits(*(each.values() for each in networks))
