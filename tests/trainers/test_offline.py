"""The offline trainer: counts, logs, checkpoints, and resuming to the same bits."""

from __future__ import annotations

import importlib.util
import json
import math
import resource
import shutil
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.checkpoint import CheckpointError
from torchrl.data import SamplerWithoutReplacement

from torchrl_osr import StatePerturbation
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import OfflineTrainer, largest_value

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


def test_updates_evaluations_and_checkpoints_come_when_due(undisturbed):
    assert undisturbed.step == undisturbed.collected_frames == STEPS
    steps = {int(row["step"]) for row in undisturbed.optimizer.state.values()}
    assert steps == {STEPS}
    assert [row["step"] for row in undisturbed.history] == [0, 5, 10, 15, 20]
    names = sorted(path.name for path in undisturbed.checkpoints.folder.iterdir())
    assert names == [
        "best.torchrl",
        "checkpoint-000000000015.torchrl",
        "checkpoint-000000000020.torchrl",
    ]


@pytest.mark.parametrize("kills", [[3], [7], [12, 3], [5, 5, 9]])
def test_killed_and_resumed_run_ends_with_the_same_bits(
    tmp_path, make, runs, undisturbed, kills
):
    wanted, step = runs.state(undisturbed), 0
    for more in kills:
        stop_at(make(tmp_path / "run"), step := step + more)
    resumed = make(tmp_path / "run")
    resumed.train()
    runs.assert_same_bits(runs.state(resumed), wanted)
    steps = [row["step"] for row in resumed.history]
    assert steps == [row["step"] for row in undisturbed.history]


def test_a_sampler_without_replacement_goes_on_in_its_epoch(tmp_path, runs):
    def make_run(folder):
        loss = runs.make_loss("inverse dynamics", states="clean")
        buffer = make_replay_buffer(runs.make_data("cpu"), batch_size=8, seed=0)
        buffer.set_sampler(SamplerWithoutReplacement())
        return OfflineTrainer(
            loss, torch.optim.Adam(loss.parameters()), buffer, STEPS, folder,
            eval_interval=5, progress=False, components={"order": buffer.sampler},
        )  # fmt: skip

    whole = make_run(tmp_path / "whole")
    whole.train()
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
def test_longer_run_goes_on_as_one_that_was_so_from_the_start(
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
    assert undisturbed.checkpoints.latest().name == "checkpoint-000000000020.torchrl"


def test_shorter_run_is_evaluated_at_its_end(tmp_path, make):
    stop_at(make(tmp_path, checkpoint_interval=7), 15)
    shorter = make(tmp_path, total_steps=14, evaluate=lambda: {"score": 9.0})
    shorter.train()
    assert shorter.history[-1] == {"step": 14, "score": 9.0}
    again = make(tmp_path, total_steps=14, evaluate=pytest.fail)
    again.train()
    assert again.history == shorter.history


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


def test_what_a_kill_left_of_removing_an_old_checkpoint_goes(
    tmp_path, make, undisturbed
):
    wanted = {path.name for path in undisturbed.checkpoints.folder.iterdir()}
    oldest = undisturbed.checkpoints.folder / "checkpoint-000000000010.torchrl"
    shutil.copy(undisturbed.checkpoints.latest(), oldest)
    make(undisturbed.checkpoints.folder).train()
    assert {path.name for path in undisturbed.checkpoints.folder.iterdir()} == wanted


@pytest.mark.parametrize("kwargs", [{"seed": 1}, {"target_net_updater": None}])
def test_sampling_and_targets_change_the_result(
    tmp_path, make, runs, undisturbed, kwargs
):
    """The equality above would be worthless if what is restored did not matter."""
    other = make(tmp_path / "other", **kwargs)
    other.train()
    pairs = zip(runs.state(other), runs.state(undisturbed), strict=True)
    assert not all(torch.equal(mine, theirs) for mine, theirs in pairs)


@pytest.mark.parametrize("mode", ["max", "min"])
def test_best_checkpoint_is_of_the_best_evaluation(tmp_path, make, mode):
    scores = iter([float("nan"), 2.0, 5.0, 1.0, 5.0])
    trainer = make(
        tmp_path, metric=("score", mode), evaluate=lambda: {"score": next(scores)}
    )
    trainer.train()
    best = {"max": 10, "min": 15}[mode]
    assert trainer.best()["step"] == best
    assert trainer.history[0] == {"step": 0, "score": None}
    with zipfile.ZipFile(trainer.checkpoints.best_path) as archive:
        manifest = json.loads(archive.read("manifest.json"))
    assert manifest["metadata"]["step"] == best
    assert set(manifest["components"]) == {"loss_module", "perturbation"}


def test_evaluation_without_the_metric_stops_before_the_first_step(tmp_path, make):
    trainer = make(tmp_path, evaluate=lambda: {"return": 1.0})
    with pytest.raises(ValueError, match=r"returned return, without the 'score'"):
        trainer.train()
    assert trainer.step == 0
    with pytest.raises(ValueError, match=r"metric\[1\] must be one of"):
        make(tmp_path, metric=("score", "largest"))


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


def test_leftovers_of_a_killed_write_are_removed(tmp_path, make):
    tmp_path.joinpath(".checkpoint-000000000005.torchrl.stage-ab").mkdir()
    tmp_path.joinpath(".checkpoint-000000000005.torchrl.archive-ab").touch()
    make(tmp_path).resume()
    assert not list(tmp_path.iterdir())


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


def test_other_errors_are_not_blamed_on_the_disk(tmp_path, make):
    class Broken:
        def log_scalar(self, *_, **__):
            raise RuntimeError("CUDA error: out of memory")

    with pytest.raises(RuntimeError, match="^CUDA error: out of memory$"):
        make(tmp_path, loggers=[Broken()]).train()


def test_data_set_is_not_in_the_checkpoint(undisturbed):
    with zipfile.ZipFile(undisturbed.checkpoints.latest()) as archive:
        names = set(json.loads(archive.read("manifest.json"))["components"])
    assert names == {
        "global_rng", "history", "loss_module", "optimizer", "perturbation",
        "progress", "sampler",
    }  # fmt: skip


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


def test_step_counts_the_running_update_through_a_resume(tmp_path, make):
    """What a schedule asks for: a hook on each batch knows which update it is."""
    seen: list[int] = []

    def watched() -> OfflineTrainer:
        trainer = make(tmp_path)
        trainer.register_op(
            "process_optim_batch", lambda batch: seen.append(trainer.step) or batch
        )
        return trainer

    stop_at(watched(), 12)
    assert seen == list(range(1, 14))
    seen.clear()
    trainer = watched()
    trainer.train()
    # The last checkpoint before update 13 is that of step 10.
    assert seen == list(range(11, STEPS + 1))
    assert trainer.step == STEPS


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_only_the_losses_are_computed_in_half_precision(tmp_path, runs, dtype):
    trainer = runs.make(tmp_path, total_steps=1, autocast_dtype=dtype)
    seen, network = [], trainer.loss_module.actor_network
    original = torch.nn.Linear.forward

    def forward(layer, inputs):
        out = original(layer, inputs)
        seen.append(out.dtype)
        return out

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.nn.Linear, "forward", forward)
        trainer.train()
    assert set(seen) == {dtype or torch.float32}
    assert {each.dtype for each in network.parameters()} <= {torch.float32}


def test_cuda_graphs_are_refused_on_a_cpu(tmp_path, runs):
    match = "cudagraph=True needs a CUDA device, got device='cpu'"
    with pytest.raises(ValueError, match=match):
        runs.make(tmp_path, cudagraph=True)


def test_largest_value_is_ten_times_the_largest_return():
    # The reward for ever: 3 + 3/2 + 3/4 + ... = 6.
    assert largest_value(3.0, 0.5) == 60.0
    assert largest_value(3.0, 1.0) == math.inf


@pytest.mark.parametrize("limits", [None, {"pred_value": 1e-9, "loss_qvalue": 1e9}])
def test_trainer_warns_once_of_a_mean_that_it_logs(tmp_path, runs, caplog, limits):
    runs.make(tmp_path, value_limits=limits).train()
    said = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert len(said) == bool(limits)
    for message in said:
        assert message.startswith("train, step 4: the mean pred_value is")
        assert "optim.qvalue_lr" in message


# tensordict 0.14.3 is slow here; when this fails, the import can go.
def test_every_module_call_of_tensordict_looks_for_pandas(monkeypatch):
    module = TensorDictModule(torch.nn.Linear(2, 2), ["a"], ["b"])
    asked, original = [], importlib.util.find_spec

    def find_spec(name, package=None):
        asked.append(name)
        return original(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    for _ in range(3):
        module(TensorDict({"a": torch.zeros(1, 2)}, [1]))
    assert asked == ["pandas"] * 3


def test_pandas_is_imported_before_the_first_update(tmp_path, runs, monkeypatch):
    imported = []
    name = "torchrl_osr.trainers.offline.import_module"
    monkeypatch.setattr(name, imported.append)
    trainer = runs.make(tmp_path, total_steps=1)
    trainer.register_op("pre_optim_steps", lambda: imported.append("update"))
    trainer.train()
    assert imported == ["pandas", "update"]
