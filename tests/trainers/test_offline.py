"""The offline trainer: counts, logs, checkpoints, and resuming to the same bits."""

from __future__ import annotations

import functools
import json
import math
import os
import resource
import shutil
import zipfile
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.objectives import SoftUpdate
from torchrl.record.loggers import CSVLogger

from torchrl_osr import StatePerturbation
from torchrl_osr.fast import fast_update
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import OfflineTrainer, largest_value
from torchrl_osr.trainers.offline import cut_back

STEPS = 20


@pytest.fixture
def make(runs):
    """Function that makes a trainer of 20 steps, which scores 0, 1, 2 and so on."""

    def make(folder: Path, *, cells: int = 8, **options) -> OfflineTrainer:
        scores = iter(range(1000))
        options = {
            "total_steps": STEPS,
            "evaluate": lambda: {"score": float(next(scores)), "raw": [1, 2]},
            "log_interval": 3,
            "eval_interval": 5,
            "checkpoint_interval": 5,
            "loss_options": {"cells": cells},
        } | options
        return runs.make(folder, **options)

    return make


@pytest.fixture
def undisturbed(make, tmp_path) -> OfflineTrainer:
    trainer = make(tmp_path / "undisturbed")
    trainer.train()
    return trainer


def stop_at(trainer: OfflineTrainer, step: int) -> None:
    """Run ``trainer`` and break it off in the middle of an update, as a kill does."""
    original = trainer.loss_module.forward

    def forward(batch):
        if trainer.step > step:
            raise RuntimeError("killed")
        return original(batch)

    trainer.loss_module.forward = forward
    with pytest.raises(RuntimeError, match="killed"):
        trainer.train()


def steps_of(trainer: OfflineTrainer) -> list[int]:
    return [row["step"] for row in trainer.history]


def test_updates_evaluations_and_checkpoints_come_when_due(undisturbed):
    assert undisturbed.step == undisturbed.collected_frames == STEPS
    steps = {int(row["step"]) for row in undisturbed.optimizer.state.values()}
    assert steps == {STEPS}
    assert steps_of(undisturbed) == [0, 5, 10, 15, 20]
    names = sorted(path.name for path in undisturbed.checkpoints.folder.iterdir())
    assert names == [
        "best.torchrl",
        "checkpoint-000000000015.torchrl",
        "checkpoint-000000000020.torchrl",
    ]


@pytest.mark.parametrize("kills", [[3], [12, 3], [5, 5, 9]])
@pytest.mark.parametrize("trace", [False, True])
def test_killed_and_resumed_run_ends_with_the_same_bits(
    tmp_path, make, runs, undisturbed, kills, trace
):
    wanted, step = runs.state(undisturbed), 0
    for more in kills:
        stop_at(make(tmp_path / "run"), step := step + more)
    resumed = make(tmp_path / "run", trace=trace, warm_up=1)
    resumed.train()
    runs.assert_same_bits(runs.state(resumed), wanted)
    assert steps_of(resumed) == steps_of(undisturbed)


@pytest.mark.parametrize(("name", "value"), [("seed", 1), ("target_updater", None)])
def test_sampling_and_targets_change_the_result(
    tmp_path, make, runs, undisturbed, name, value
):
    """The equality above would be worthless if what is restored did not matter."""
    other = make(tmp_path / "other", **{name: value})
    other.train()
    pairs = zip(runs.state(other), runs.state(undisturbed), strict=True)
    assert not all(torch.equal(mine, theirs) for mine, theirs in pairs)


def test_a_sampler_without_replacement_goes_on_in_its_epoch(tmp_path, runs):
    def make_run(folder):
        loss = runs.make_loss("inverse dynamics", states="clean")
        buffer = make_replay_buffer(runs.make_data("cpu"), batch_size=8, seed=0)
        buffer.set_sampler(SamplerWithoutReplacement())
        update = fast_update(loss, torch.optim.Adam(loss.parameters()))
        return OfflineTrainer(
            update, buffer, STEPS, folder, checkpoint_interval=5, progress=False
        )

    whole = make_run(tmp_path / "whole")
    whole.train()
    stop_at(make_run(tmp_path / "run"), 7)
    resumed = make_run(tmp_path / "run")
    resumed.train()
    runs.assert_same_bits(runs.state(resumed), runs.state(whole))


class Tree:
    """A segment tree of TorchRL's extension, which one of torch's versions lacks."""

    def __init__(self, capacity: int, reduce, empty: float) -> None:
        self.values, self.reduce = torch.full((capacity,), empty), reduce

    def __getitem__(self, index):
        return self.values[index]

    def __setitem__(self, index, value):
        self.values[index] = torch.as_tensor(value, dtype=torch.float32)

    def query(self, start: int, end: int) -> float:
        return self.reduce(self.values[start:end]).item()

    def scan_lower_bound(self, mass):
        return torch.searchsorted(self.values.cumsum(0), torch.as_tensor(mass))


@pytest.mark.parametrize("trace", [False, True])
def test_priorities_follow_the_errors_and_are_restored(
    tmp_path, runs, monkeypatch, trace
):
    module = "torchrl.data.replay_buffers.samplers.prioritized"
    trees = {"Sum": (torch.sum, 0.0), "Min": (torch.min, math.inf)}
    for kind, (reduce, empty) in trees.items():
        tree = functools.partial(Tree, reduce=reduce, empty=empty)
        for bits in (32, 64):
            monkeypatch.setattr(f"{module}.{kind}SegmentTreeFp{bits}", tree)

    def make_run(folder):
        loss, rows = runs.make_loss("OSR"), runs.make_data("cpu")
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(64), batch_size=8,
            sampler=PrioritizedSampler(64, alpha=0.7, beta=0.5),
            priority_key="td_error", transform=StatePerturbation(0.1, seed=0),
        )  # fmt: skip
        buffer.extend(rows)
        optimizer = torch.optim.Adam(loss.parameters())
        updater = SoftUpdate(loss, tau=0.1)
        update = fast_update(loss, optimizer, updater, trace=trace, warm_up=2)
        return OfflineTrainer(
            update, buffer, STEPS, folder, checkpoint_interval=5, progress=False,
            components={"perturbation": buffer.transform[-1]},
        )  # fmt: skip

    whole = make_run(tmp_path / "whole")
    before = whole.buffer.sampler._sum_tree[torch.arange(64)]
    whole.train()
    after = whole.buffer.sampler._sum_tree[torch.arange(64)]
    assert (before != after).sum() > 32
    stop_at(make_run(tmp_path / "run"), 7)
    resumed = make_run(tmp_path / "run")
    resumed.train()
    runs.assert_same_bits(runs.state(resumed), runs.state(whole))


def test_components_cannot_take_the_place_of_the_trainers_own(tmp_path, make):
    match = r"components have names of the trainer's own: \['sampler'\]"
    with pytest.raises(ValueError, match=match):
        make(tmp_path, components={"sampler": StatePerturbation(0.1)})


def test_finished_run_returns_at_once(make, undisturbed):
    again = make(undisturbed.checkpoints.folder, evaluate=pytest.fail)
    again.train()
    assert again.history == undisturbed.history


@pytest.mark.parametrize("step", [7, 20])
def test_longer_run_equals_one_that_was_so_from_the_start(
    tmp_path, make, runs, undisturbed, step
):
    """Killed before, or finished; other intervals change no update."""
    short = {"total_steps": 10, "eval_interval": 2, "checkpoint_interval": 3}
    if step < 10:
        stop_at(make(tmp_path, **short), step)
    else:
        make(tmp_path, **short).train()
    longer = make(tmp_path)
    longer.train()
    networks = longer.loss_module.state_dict(), undisturbed.loss_module.state_dict()
    runs.assert_same_bits(*(each.values() for each in networks))
    assert longer.history[-1]["step"] == STEPS


def test_fewer_steps_than_were_done_are_refused(make, undisturbed):
    folder = undisturbed.checkpoints.folder
    with pytest.raises(ValueError, match="is at step 20, beyond the 19 steps"):
        make(folder, total_steps=19).train()


def test_shorter_run_is_evaluated_at_its_end(tmp_path, make):
    stop_at(make(tmp_path, checkpoint_interval=7), 15)
    shorter = make(tmp_path, total_steps=14, evaluate=lambda: {"score": 9.0})
    shorter.train()
    assert shorter.history[-1] == {"step": 14, "score": 9.0}
    again = make(tmp_path, total_steps=14, evaluate=pytest.fail)
    again.train()
    assert again.history == shorter.history


# -- evaluations ----------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["max", "min"])
def test_best_checkpoint_is_of_the_best_evaluation(tmp_path, make, mode):
    scores = iter([0.0, 2.0, 5.0, 1.0, 5.0])
    trainer = make(
        tmp_path, metric=("score", mode), evaluate=lambda: {"score": next(scores)}
    )
    trainer.train()
    best = {"max": 10, "min": 15}[mode]  # not the untrained one, which has 0
    assert trainer.best()["step"] == best
    with zipfile.ZipFile(trainer.checkpoints.best_path) as archive:
        manifest = json.loads(archive.read("manifest.json"))
    assert manifest["metadata"]["step"] == best
    assert set(manifest["components"]) == {"loss_module", "perturbation"}


def test_the_untrained_evaluation_is_best_only_by_itself(tmp_path, make):
    scores = iter([1.0, *[float("nan")] * 9])
    trainer = make(tmp_path, evaluate=lambda: {"score": next(scores)})
    trainer.train()
    assert trainer.history[1] == {"step": 5, "score": None}
    assert trainer.best()["step"] == 0


def test_evaluation_without_the_metric_stops_before_the_first_step(tmp_path, make):
    trainer = make(tmp_path, evaluate=lambda: {"return": 1.0})
    with pytest.raises(ValueError, match="returned return, without the metric 'score'"):
        trainer.train()
    assert trainer.step == 0


def failing(*steps: int):
    """Make an evaluation that fails at some steps."""

    def evaluate():
        if trainer[0].step in steps:
            raise ArithmeticError("the simulator broke")
        return {"score": float(trainer[0].step)}

    trainer: list[OfflineTrainer] = []
    return trainer, evaluate


def test_a_failing_evaluation_costs_itself_alone(
    tmp_path, make, runs, undisturbed, caplog
):
    holder, evaluate = failing(5, 20)
    holder.append(trainer := make(tmp_path, evaluate=evaluate))
    trainer.train()
    names = list(undisturbed.loss_module.state_dict())
    pairs = trainer.loss_module.state_dict(), undisturbed.loss_module.state_dict()
    runs.assert_same_bits(*([each[key] for key in names] for each in pairs))
    assert steps_of(trainer) == [0, 10, 15]
    assert [row["step"] for row in trainer.failed_evaluations] == [5, 20]
    assert "step 5: ArithmeticError: the simulator broke" in caplog.text
    # Run again, the finished run repeats the evaluation of its end alone.
    holder, evaluate = failing()
    holder.append(again := make(tmp_path, evaluate=evaluate))
    again.train()
    assert steps_of(again) == [0, 10, 15, 20]
    assert [row["step"] for row in again.failed_evaluations] == [5]


def test_an_evaluation_that_kills_the_process_loses_no_step(
    tmp_path, make, runs, undisturbed
):
    def evaluate():
        if trainer.step == 10:
            raise KeyboardInterrupt
        return {"score": trainer.step / 5, "raw": [1, 2]}

    trainer = make(tmp_path, evaluate=evaluate)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert trainer.checkpoints.latest().name == "checkpoint-000000000010.torchrl"
    resumed = make(
        tmp_path, evaluate=lambda: {"score": resumed.step / 5, "raw": [1, 2]}
    )
    resumed.train()
    assert resumed.history == undisturbed.history
    runs.assert_same_bits(runs.state(resumed), runs.state(undisturbed))


# -- checkpoints ----------------------------------------------------------------------


@pytest.mark.parametrize("logged", [False, True])
def test_folder_that_is_removed_is_not_made_anew(tmp_path, make, runs, logged):
    folder = tmp_path / "run"
    trainer = make(folder, loggers=[runs.log_of([])] if logged else [])

    def remove(batch):
        if trainer.step == 7:
            shutil.rmtree(folder)
        return batch

    trainer.register_op("process_optim_batch", remove)
    message = f"^{folder} was removed or renamed while the run was going on"
    with pytest.raises(FileNotFoundError, match=message):
        trainer.train()
    assert trainer.step < STEPS
    assert not folder.exists()


def corrupt(path: Path) -> None:
    """Flip one bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


@pytest.mark.parametrize("damage", [corrupt, truncate])
def test_damaged_newest_checkpoint_falls_back_to_the_one_before(
    make, runs, undisturbed, damage, caplog
):
    wanted, folder = runs.state(undisturbed), undisturbed.checkpoints.folder
    damage(folder / "checkpoint-000000000020.torchrl")
    resumed = make(folder)
    assert resumed.resume().name == "checkpoint-000000000015.torchrl"
    assert "is damaged" in caplog.text
    resumed.train()
    runs.assert_same_bits(runs.state(resumed), wanted)


def test_only_damaged_checkpoints_are_an_error_not_a_new_start(make, undisturbed):
    for path in undisturbed.checkpoints.folder.glob("checkpoint-*"):
        corrupt(path)
    with pytest.raises(CheckpointError, match="All 2 checkpoints"):
        make(undisturbed.checkpoints.folder).train()


def test_checkpoint_of_another_network_is_refused(make, undisturbed):
    with pytest.raises(CheckpointError, match=r"weight is \(8, 3\) in the file, \(16,"):
        make(undisturbed.checkpoints.folder, cells=16).train()


def test_leftovers_of_a_kill_are_removed(tmp_path, make, undisturbed):
    folder = undisturbed.checkpoints.folder
    wanted = {path.name for path in folder.iterdir()}
    folder.joinpath(".checkpoint-000000000005.torchrl.stage-ab").mkdir()
    folder.joinpath(".checkpoint-000000000005.torchrl.archive-ab").touch()
    shutil.copy(
        undisturbed.checkpoints.latest(), folder / "checkpoint-000000000010.torchrl"
    )
    make(folder).resume()
    assert {path.name for path in folder.iterdir()} == wanted


def test_full_disk_names_the_folder_and_keeps_the_last_checkpoint(tmp_path, make):
    """A limit on the size of files stands in for the disk's."""
    stop_at(make(tmp_path), 7)
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    trainer = make(tmp_path)
    trainer.register_op(
        "pre_optim_steps",
        lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (3000, most)),
    )
    try:
        match = f"{tmp_path}.*File too large.*checkpoint-000000000005"
        with pytest.raises(OSError, match=match):
            trainer.train()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))
    names = {path.name for path in tmp_path.glob("check*")}
    assert names == {"checkpoint-000000000005.torchrl"}


def test_data_set_is_not_in_the_checkpoint(undisturbed):
    with zipfile.ZipFile(undisturbed.checkpoints.latest()) as archive:
        names = set(json.loads(archive.read("manifest.json"))["components"])
    assert names == {
        "failed_evaluations", "global_rng", "history", "loss_module", "optimizer",
        "perturbation", "progress", "sampler",
    }  # fmt: skip


# -- logs and hooks -------------------------------------------------------------------


def test_numbers_are_logged_as_means_over_the_interval(tmp_path, make, runs):
    numbers, seen = [], []
    trainer = make(tmp_path, loggers=[runs.log_of(numbers)])
    original = trainer.loss_module.forward
    trainer.loss_module.forward = lambda batch: seen.append(original(batch)) or seen[-1]
    trainer.train()
    scores = [step for name, step, _ in numbers if name == "train/score"]
    assert scores == [0, 5, 10, 15, 20]
    losses = [row[1:] for row in numbers if row[0] == "train/loss_qvalue"]
    steps = [3, 5, 6, 9, 10, 12, 15, 18, 20]
    assert [step for step, _ in losses] == steps
    for start, (end, value) in zip([0, *steps], losses, strict=False):
        mean = torch.stack([row["loss_qvalue"] for row in seen[start:end]]).mean()
        assert value == pytest.approx(mean.item(), rel=1e-5)
    assert "train/raw" not in {name for name, *_ in numbers}


rows = st.dictionaries(st.integers(0, 50), st.floats(allow_nan=False))


@given(rows, st.integers(-1, 50), st.sampled_from(["", "6", "60,", "60,0.1"]))
def test_csv_rows_are_cut_back_to_the_step(tmp_path_factory, rows, step, end):
    folder = tmp_path_factory.mktemp("rows")
    lines = [f"{number},{value}\n" for number, value in sorted(rows.items())]
    (folder / "loss.csv").write_text("".join(lines) + end)  # killed within a line
    cut_back(folder, step)
    kept = sum(number <= step for number in rows)
    assert (folder / "loss.csv").read_text() == "".join(lines[:kept])


@pytest.mark.parametrize("interval", [5, 100])
def test_killed_run_logs_no_step_twice(tmp_path, make, interval):
    """Killed in its last step, some time after its last checkpoint or before any."""

    def make_logged(folder):
        return make(
            tmp_path / folder,
            checkpoint_interval=interval,
            log_interval=1,
            loggers=[CSVLogger("csv", log_dir=str(tmp_path / folder))],
        )

    def read(folder):
        files = (tmp_path / folder / "csv" / "scalars" / "train").glob("loss*.csv")
        return {path.name: path.read_text() for path in files}

    make_logged("undisturbed").train()
    stop_at(make_logged("killed"), 19)
    before = read("killed")
    make_logged("killed").train()
    assert read("killed") == read("undisturbed") != before


def test_hooks_run_in_the_order_that_is_written_down(tmp_path, runs):
    order = []

    def note(name):
        return lambda *_: order.append(name)

    places = (
        "process_optim_batch", "post_optim", "post_optim_log",
        "post_optim_complete_log", "post_steps", "post_steps_log",
    )  # fmt: skip
    trainer = runs.make(
        tmp_path, total_steps=1, hooks=[(place, note(place)) for place in places]
    )
    original = trainer.checkpoints.save
    trainer.checkpoints.save = lambda step: (order.append("saved"), original(step))
    trainer.train()
    assert order == [*places[:5], "saved", places[5]]


def test_step_counts_the_running_update_through_a_resume(tmp_path, make):
    seen: list[int] = []

    def watched() -> OfflineTrainer:
        hooks = [("process_optim_batch", lambda _: seen.append(trainer.step))]
        trainer = make(tmp_path, hooks=hooks)
        return trainer

    stop_at(watched(), 12)
    assert seen == list(range(1, 14))
    seen.clear()
    watched().train()
    # The last checkpoint before update 13 is that of step 10.
    assert seen == list(range(11, STEPS + 1))


def test_any_loss_module_can_be_trained(tmp_path, runs):
    trainer = runs.make(tmp_path, "inverse dynamics", total_steps=100)
    batch = trainer.buffer.sample()
    before = trainer.loss_module(batch)["loss_inverse_dynamics"].item()
    trainer.train()
    after = trainer.loss_module(batch)["loss_inverse_dynamics"].item()
    assert after < before - 0.3
    assert trainer.best() is None


@pytest.mark.parametrize(
    "name", ["total_steps", "log_interval", "eval_interval", "checkpoint_interval"]
)
def test_intervals_must_be_positive(tmp_path, make, name):
    with pytest.raises(ValueError, match="at least 1"):
        make(tmp_path, **{name: 0})


@pytest.mark.parametrize("limits", [None, {"pred_value": 1e-9, "loss_qvalue": 1e9}])
def test_trainer_warns_once_of_values_that_diverge(tmp_path, runs, caplog, limits):
    runs.make(tmp_path, value_limits=limits).train()
    said = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert len(said) == bool(limits)
    for message in said:
        assert message.startswith("train, step 4: the mean pred_value is")
    # The reward for ever: 3 + 3/2 + 3/4 + ... = 6.
    assert largest_value(3.0, 0.5) == 60.0
    assert largest_value(3.0, 1.0) == math.inf


# -- updates that are not finite ------------------------------------------------------


def poisoned(runs, folder, step: int, **options) -> OfflineTrainer:
    """Return a trainer whose rewards are NaN at a step."""

    def spoil(batch):
        if trainer.step == step:
            batch["next", "reward"].fill_(math.nan)

    trainer = runs.make(folder, hooks=[("process_optim_batch", spoil)], **options)
    return trainer


@pytest.mark.parametrize("step", [1, 7])
@pytest.mark.parametrize("trace", [False, True])
def test_run_stops_before_a_step_that_is_not_finite(tmp_path, runs, step, trace):
    trainer = poisoned(runs, tmp_path / "run", step, trace=trace, warm_up=1)
    match = f"train: step {step}: not finite: losses .*loss_qvalue.*; gradients qvalue"
    with pytest.raises(FloatingPointError, match=match) as raised:
        trainer.train()
    path = tmp_path / "run" / "nonfinite" / f"step-{step:012d}.pt"
    assert f"torch.load('{path}', weights_only=True)" in str(raised.value)
    saved = torch.load(path, weights_only=True)
    assert saved["batch"]["next"]["reward"].isnan().all()
    assert math.isfinite(saved["losses"]["loss_actor"])
    assert all(name.startswith("qvalue_network_params") for name in saved["gradients"])
    # The networks are those of the updates before, and give that loss.
    before = runs.make(tmp_path / "before", total_steps=max(step - 1, 1))
    if step > 1:
        before.train()
    wanted = dict(before.loss_module.named_parameters())
    runs.assert_same_bits(
        [saved["loss_module"][key] for key in wanted], wanted.values()
    )
    batch = TensorDict(saved["batch"], [8])
    assert before.loss_module(batch)["loss_qvalue"].isnan()


def test_full_disk_does_not_hide_why_the_run_stops(tmp_path, runs, monkeypatch):
    trainer = poisoned(runs, tmp_path, 2)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FloatingPointError, match="not be written: .*No space left"):
        trainer.train()
    assert not list(tmp_path.glob("nonfinite/*"))
