"""Room on the disk is looked for before the work, not after it."""

from __future__ import annotations

import errno
import shutil
from collections import namedtuple

import pytest
import torch

from torchrl_osr._files import check_disk_space
from torchrl_osr.lab.data import load_dataset, make_replay_buffer, sources
from torchrl_osr.modules import tanh_gaussian_inverse_dynamics
from torchrl_osr.objectives import InverseDynamicsLoss
from torchrl_osr.trainers import OfflineTrainer

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def free(monkeypatch):
    """Return what sets the free bytes of every disk; asked are notes of where."""
    asked = []

    def set_free(number: int):
        def disk_usage(path):
            asked.append(path)
            return Usage(10**12, 0, number)

        monkeypatch.setattr(shutil, "disk_usage", disk_usage)
        return asked

    return set_free


def test_what_is_needed_and_what_is_free_are_said(tmp_path, free):
    asked = free(2_500_000)
    folder = tmp_path / "not" / "yet" / "there"
    check_disk_space(folder, 2_500_000, "a file")
    match = "3.0 GB are needed for a file, 2.5 MB are free. Free space"
    with pytest.raises(OSError, match=match) as raised:
        check_disk_space(folder, 3_000_000_000, "a file")
    assert raised.value.errno == errno.ENOSPC
    assert raised.value.filename == str(folder)
    assert asked == [tmp_path] * 2


@pytest.mark.parametrize(
    ("size", "said"), [(999, "999 bytes"), (1000, "1.0 kB"), (10**6, "1.0 MB")]
)
def test_sizes_are_in_the_unit_that_people_use(tmp_path, free, size, said):
    free(0)
    with pytest.raises(OSError, match=f"{said} are needed .* 0 bytes are free"):
        check_disk_space(tmp_path, size, "it")


def make_trainer(folder, make_batch, **options) -> OfflineTrainer:
    model = tanh_gaussian_inverse_dynamics(3, 2, num_cells=[64])
    loss = InverseDynamicsLoss(model, states="clean")
    data = make_batch(16, twin=False)
    data = data.apply(lambda x: x.float() if x.is_floating_point() else x)
    return OfflineTrainer(
        loss,
        torch.optim.Adam(loss.parameters()),
        make_replay_buffer(data, batch_size=4, seed=0),
        total_steps=4,
        folder=folder,
        progress=False,
        **options,
    )


def test_training_does_not_begin_without_room(tmp_path, make_batch, free):
    trainer = make_trainer(tmp_path, make_batch, checkpoints_kept=3)
    # Each parameter with two moments, in four bytes; three kept, the best, the
    # newest, one being written.
    needed = 6 * sum(3 * 4 * each.numel() for each in trainer.loss_module.parameters())
    free(needed - 1)
    with pytest.raises(OSError, match="for 6 checkpoints"):
        trainer.train()
    assert trainer.step == 0
    free(needed)
    trainer.train()
    # What is there need not fit a second time, and what is done needs nothing.
    (path,) = tmp_path.glob("check*")
    assert path.stat().st_size > needed / 6
    free(0)
    make_trainer(tmp_path, make_batch).train()


def test_collection_does_not_begin_without_room(tmp_path, free, monkeypatch):
    asked = free(1000)
    monkeypatch.setattr(sources, "collect_source", pytest.fail)
    # Hopper: twice 11 numbers, 3 and the reward, and three flags.
    match = "107.0 kB are needed for the data set.*TORCHRL_OSR_CACHE=/path"
    with pytest.raises(OSError, match=match):
        load_dataset("hopper", "random", num_transitions=1000, cache_dir=tmp_path)
    assert asked
