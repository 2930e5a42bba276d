"""The offline trainer: counts, logs, checkpoints, and resuming to the same bits."""

from __future__ import annotations

import errno
import json
import os
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError
from torchrl.objectives import SoftUpdate
from torchrl.record.loggers import CSVLogger

from torchrl_osr import InverseDynamicsLoss, OSRLoss, StatePerturbation
from torchrl_osr.data import make_replay_buffer
from torchrl_osr.evaluation import read_scalars
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import OfflineTrainer

STEPS = 20


def make_data(rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(rows, 3, generator=generator)
    action = torch.rand(rows, 2, generator=generator) - 0.5
    no = torch.zeros(rows, 1, dtype=torch.bool)
    following = {
        "observation": state.roll(1, 0),
        "reward": state[:, :1].clone(),
        "done": no,
        "terminated": no.clone(),
    }
    return TensorDict(
        {"observation": state, "action": action, "next": following}, [rows]
    )


def make_trainer(folder: Path, *, cells: int = 8, **kwargs) -> OfflineTrainer:
    """Return a fresh OSR trainer; two of them are the same run up to their folders."""
    torch.manual_seed(0)
    perturbation = StatePerturbation(0.1, seed=0)
    buffer = make_replay_buffer(
        make_data(), batch_size=8, seed=0, transform=perturbation
    )
    loss = OSRLoss(
        tanh_gaussian_actor(3, 2, num_cells=[cells]),
        critic_ensemble(3, 2, num_cells=[cells]),
        tanh_gaussian_inverse_dynamics(3, 2, num_cells=[cells]),
        num_random=2,
    )
    loss.make_value_estimator(gamma=0.9)
    scores = iter(range(1000))
    options = {
        "total_steps": STEPS,
        "target_net_updater": SoftUpdate(loss, tau=0.1),
        "components": {"perturbation": perturbation},
        "evaluate": lambda: {"score": float(next(scores)), "raw": [1, 2]},
        "log_interval": 3,
        "eval_interval": 5,
        "progress": False,
    } | kwargs
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
    return OfflineTrainer(loss, optimizer, buffer, folder=folder, **options)


def stop_at(trainer: OfflineTrainer, step: int) -> None:
    """Run ``trainer`` and break it off in the middle of an update."""
    updates = 0
    original = trainer.loss_module.forward

    def forward(batch):
        nonlocal updates
        updates += 1
        if updates > step:
            raise KeyboardInterrupt
        return original(batch)

    trainer.loss_module.forward = forward
    with pytest.raises(KeyboardInterrupt):
        trainer.train()


def state_of(trainer: OfflineTrainer) -> list[torch.Tensor]:
    optimizer = [
        value
        for row in trainer.optimizer.state_dict()["state"].values()
        for value in row.values()
    ]
    return [*trainer.loss_module.state_dict().values(), *optimizer]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> OfflineTrainer:
    trainer = make_trainer(tmp_path_factory.mktemp("undisturbed"))
    trainer.train()
    return trainer


def test_updates_evaluations_and_checkpoints_come_when_due(undisturbed):
    assert undisturbed.collected_frames == STEPS
    steps = {int(row["step"]) for row in undisturbed.optimizer.state.values()}
    assert steps == {STEPS}
    assert [row["step"] for row in undisturbed.history] == [5, 10, 15, 20]
    names = sorted(path.name for path in undisturbed.rotation.directory.iterdir())
    assert names == [
        "best.torchrl",
        "checkpoint-000000000015.torchrl",
        "checkpoint-000000000020.torchrl",
    ]


@pytest.mark.parametrize("kills", [[7], [12, 3], [5, 5, 9]])
def test_killed_and_resumed_run_ends_with_the_same_bits(tmp_path, undisturbed, kills):
    for step in kills:
        stop_at(make_trainer(tmp_path), step)
    resumed = make_trainer(tmp_path)
    resumed.train()
    for mine, theirs in zip(state_of(resumed), state_of(undisturbed), strict=True):
        assert torch.equal(mine, theirs)
    steps = [row["step"] for row in resumed.history]
    assert steps == [row["step"] for row in undisturbed.history]
    assert torch.equal(torch.rand(3), _rand_after(undisturbed, tmp_path))


def _rand_after(undisturbed: OfflineTrainer, folder: Path) -> torch.Tensor:
    """Return the global generator's next draws as the undisturbed run left it."""
    make_trainer(undisturbed.rotation.directory).resume()
    return torch.rand(3)


def test_finished_run_returns_at_once(tmp_path, undisturbed):
    again = make_trainer(undisturbed.rotation.directory, evaluate=pytest.fail)
    again.train()
    assert again.history == undisturbed.history


@pytest.mark.parametrize("kwargs", [{"seed": 1}, {"target_net_updater": None}])
def test_sampling_and_targets_change_the_result(tmp_path, undisturbed, kwargs):
    """The equality above would be worthless if what is restored did not matter."""
    other = make_trainer(tmp_path, **kwargs)
    other.train()
    pairs = zip(state_of(other), state_of(undisturbed), strict=True)
    assert not all(torch.equal(mine, theirs) for mine, theirs in pairs)


@pytest.mark.parametrize("mode", ["max", "min"])
def test_best_checkpoint_is_of_the_best_evaluation(tmp_path, mode):
    scores = iter([2.0, 5.0, 1.0, 5.0])
    trainer = make_trainer(
        tmp_path, metric=("score", mode), evaluate=lambda: {"score": next(scores)}
    )
    trainer.train()
    best = {"max": 10, "min": 15}[mode]
    assert trainer.best()["step"] == best
    with zipfile.ZipFile(trainer.best_path) as archive:
        manifest = json.loads(archive.read("manifest.json"))
    assert manifest["metadata"]["step"] == best
    assert set(manifest["components"]) == {"loss_module", "perturbation"}


def test_numbers_are_logged_as_means_over_the_interval(tmp_path):
    trainer = make_trainer(
        tmp_path / "run", loggers=[CSVLogger("csv", log_dir=str(tmp_path))]
    )
    seen = []
    original = trainer.loss_module.forward
    trainer.loss_module.forward = lambda batch: seen.append(original(batch)) or seen[-1]
    trainer.train()
    scalars = read_scalars(tmp_path / "csv" / "scalars" / "train")
    assert [step for step, _ in scalars["score"]] == [5, 10, 15, 20]
    steps = [3, 5, 6, 9, 10, 12, 15, 18, 20]
    assert [step for step, _ in scalars["loss_qvalue"]] == steps
    for start, (end, value) in zip([0, *steps], scalars["loss_qvalue"], strict=False):
        mean = torch.stack([row["loss_qvalue"] for row in seen[start:end]]).mean()
        assert value == pytest.approx(mean.item(), rel=1e-5)
    assert "raw" not in scalars


def test_non_finite_loss_stops_the_run_and_names_it(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.loss_module.min_q_weight = float("nan")
    with pytest.raises(FloatingPointError, match="step 1: .*losses loss_cql"):
        trainer.train()
    assert not list(tmp_path.glob("checkpoint-*"))


def corrupt(path: Path) -> None:
    """Flip one bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_damaged_newest_checkpoint_falls_back_to_the_one_before(
    tmp_path, undisturbed, caplog
):
    make_trainer(tmp_path).train()
    corrupt(tmp_path / "checkpoint-000000000020.torchrl")
    resumed = make_trainer(tmp_path)
    assert resumed.resume().name == "checkpoint-000000000015.torchrl"
    resumed.train()
    for mine, theirs in zip(state_of(resumed), state_of(undisturbed), strict=True):
        assert torch.equal(mine, theirs)


def test_only_damaged_checkpoints_are_an_error_not_a_new_start(tmp_path):
    make_trainer(tmp_path).train()
    for path in tmp_path.glob("checkpoint-*"):
        corrupt(path)
    with pytest.raises(CheckpointError, match="All 2 checkpoints"):
        make_trainer(tmp_path).train()


def test_truncated_checkpoint_is_not_taken_for_a_whole_one(tmp_path):
    make_trainer(tmp_path).train()
    newest = tmp_path / "checkpoint-000000000020.torchrl"
    newest.write_bytes(newest.read_bytes()[:1000])
    assert make_trainer(tmp_path).resume().name == "checkpoint-000000000015.torchrl"


def test_checkpoint_of_another_network_is_refused(tmp_path):
    make_trainer(tmp_path).train()
    with pytest.raises(CheckpointError, match=r"weight is \(8, 3\) in the file, \(16,"):
        make_trainer(tmp_path, cells=16).train()


def test_checkpoint_cannot_run_code(tmp_path):
    """A pickle that would make a folder is refused before it does."""
    make_trainer(tmp_path).train()
    newest = tmp_path / "checkpoint-000000000020.torchrl"
    trap = tmp_path / "trap"

    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(trap),)

    with zipfile.ZipFile(newest) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    payload = tmp_path / "payload.pt"
    torch.save({"state": Malicious()}, payload)
    victim = next(name for name in members if "sampler" in name)
    members[victim] = payload.read_bytes()
    with zipfile.ZipFile(newest, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(CheckpointError, match="[Ww]eights"):
        make_trainer(tmp_path).resume()
    assert not trap.exists()
    # The trap works where pickles are trusted, or this test would prove nothing.
    torch.load(payload, weights_only=False)
    assert trap.exists()


def test_leftovers_of_a_killed_write_are_removed(tmp_path):
    tmp_path.joinpath(".checkpoint-000000000005.torchrl.stage-ab").mkdir()
    tmp_path.joinpath(".checkpoint-000000000005.torchrl.archive-ab").touch()
    make_trainer(tmp_path).resume()
    assert not list(tmp_path.iterdir())


def test_full_disk_names_the_folder_and_keeps_the_last_checkpoint(
    tmp_path, monkeypatch
):
    stop_at(make_trainer(tmp_path), 7)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(torch, "save", full)
    match = f"{tmp_path}.*No space left.*checkpoint-000000000005"
    with pytest.raises(OSError, match=match):
        make_trainer(tmp_path).train()
    assert [path.name for path in tmp_path.glob("check*")] == [
        "checkpoint-000000000005.torchrl"
    ]


def test_data_set_is_not_in_the_checkpoint(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.train()
    with zipfile.ZipFile(trainer.rotation.latest()) as archive:
        names = set(json.loads(archive.read("manifest.json"))["components"])
    assert names == {
        "global_rng", "history", "loss_module", "optimizer", "perturbation",
        "progress", "sampler",
    }  # fmt: skip


def test_any_loss_module_can_be_trained(tmp_path):
    loss = InverseDynamicsLoss(
        tanh_gaussian_inverse_dynamics(3, 2, num_cells=[32]), states="clean"
    )
    trainer = OfflineTrainer(
        loss,
        torch.optim.Adam(loss.parameters(), lr=1e-2),
        make_replay_buffer(make_data(), batch_size=32, seed=0),
        total_steps=100,
        folder=tmp_path,
        progress=False,
    )
    before = loss(make_data())["loss_inverse_dynamics"].item()
    trainer.train()
    assert loss(make_data())["loss_inverse_dynamics"].item() < before - 0.3
    assert trainer.best() is None


@pytest.mark.parametrize("name", ["total_steps", "log_interval", "eval_interval"])
def test_intervals_must_be_positive(tmp_path, name):
    with pytest.raises(ValueError, match="at least 1"):
        make_trainer(tmp_path, **{name: 0})


def test_step_counts_the_running_update_through_a_resume(tmp_path):
    """What a warm start asks for: a hook on each batch knows which update it is."""
    seen: list[int] = []

    def watched() -> OfflineTrainer:
        trainer = make_trainer(tmp_path)

        def note(batch):
            seen.append(trainer.step)
            return batch

        trainer.register_op("process_optim_batch", note)
        return trainer

    stop_at(watched(), 12)
    assert seen == list(range(1, 14))
    seen.clear()
    trainer = watched()
    trainer.train()
    # The last checkpoint before update 13 is that of step 10.
    assert seen == list(range(11, STEPS + 1))
    assert trainer.step == STEPS
