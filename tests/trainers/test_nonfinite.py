"""Losses and gradients that are not finite stop the run, and are kept.

On a CPU every update is checked before its step. Tests that say ``deferred`` do on the
CPU what is done on a GPU, where the host looks at the end of a log interval.
"""

from __future__ import annotations

import errno
import math
import os

import pytest
import torch
from tensordict import TensorDict

REWARD = ("next", "reward")


def poison(trainer, *steps: int):
    """Make the rewards of some updates' batches NaN; return the trainer."""

    def spoil(batch):
        factor = math.nan if trainer.step in steps else 1.0
        return batch.set(REWARD, factor * batch[REWARD])

    trainer.register_op("process_optim_batch", spoil)
    return trainer


def learnt(trainer) -> list[torch.Tensor]:
    """The trained parameters and the optimizer's state, cloned."""
    rows = trainer.optimizer.state_dict()["state"].values()
    state = [value for row in rows for value in row.values()]
    parameters = trainer.loss_module.parameters()
    return [each.detach().clone() for each in (*parameters, *state)]


@pytest.fixture(params=[False, True], ids=["at once", "deferred"])
def make(request, runs):
    """Function that makes a trainer, which checks in one way or the other."""

    def make(folder, **options):
        trainer = runs.make(folder, **options)
        trainer.nonfinite_check.deferred = request.param
        return trainer

    return make


@pytest.mark.parametrize("step", [1, 2, 7, 8])
def test_run_stops_with_what_led_to_it(tmp_path, runs, make, step):
    trainer = poison(make(tmp_path / "run"), step)
    match = f"train: step {step}: not finite: losses .*loss_qvalue.*; gradients qvalue"
    with pytest.raises(FloatingPointError, match=match) as raised:
        trainer.train()
    path = tmp_path / "run" / "nonfinite" / f"step-{step:012d}.pt"
    assert f"torch.load('{path}', weights_only=True)" in str(raised.value)
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    saved = torch.load(path, weights_only=True)
    assert saved["step"] == step
    assert saved["batch"]["next"]["reward"].isnan().all()
    assert saved["batch"]["observation"].shape == (8, 3)
    assert math.isnan(saved["losses"]["loss_qvalue"])
    assert math.isfinite(saved["losses"]["loss_actor"])
    assert saved["gradients"]
    assert all(name.startswith("qvalue_network_params") for name in saved["gradients"])
    # Networks and moments are those of the updates before, to the bit.
    before = runs.make(tmp_path / "before", total_steps=max(step - 1, 1))
    if step > 1:
        before.train()
        runs.assert_same_bits(learnt(trainer), learnt(before))
    wanted = dict(before.loss_module.named_parameters())
    runs.assert_same_bits(
        [saved["loss_module"][key] for key in wanted], wanted.values()
    )
    # And they give the loss that was not finite.
    before.loss_module.load_state_dict(saved["loss_module"])
    batch = TensorDict(saved["batch"], [8])
    assert before.loss_module(batch)["loss_qvalue"].isnan()


def test_gradient_of_a_finite_loss_is_named(tmp_path, make):
    trainer = make(tmp_path)
    original = trainer.loss_module.forward
    parameters = dict(trainer.loss_module.named_parameters())
    name = next(each for each in parameters if each.startswith("actor"))

    def forward(batch):
        losses = original(batch)
        losses["loss_root"] = (0 * parameters[name]).square().sum().sqrt()
        return losses

    trainer.loss_module.forward = forward
    match = (
        f"step 1: not finite: losses none; gradients {name}\\. .* checkpoint is None"
    )
    with pytest.raises(FloatingPointError, match=match):
        trainer.train()


def test_full_disk_does_not_hide_why_the_run_stops(tmp_path, runs, monkeypatch):
    trainer = poison(runs.make(tmp_path), 2)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FloatingPointError, match="not be written: .*No space left"):
        trainer.train()
    assert not list(tmp_path.glob("nonfinite/*"))


def test_batches_of_another_size_are_kept_too(tmp_path, make):
    trainer = make(tmp_path)
    trainer.register_op(
        "process_optim_batch",
        lambda batch: batch[:5] if trainer.step == 3 else batch,
    )
    with pytest.raises(FloatingPointError, match="step 3: "):
        poison(trainer, 3).train()
    saved = torch.load(next(tmp_path.glob("nonfinite/*")), weights_only=True)
    assert saved["batch"]["observation"].shape == (5, 3)
