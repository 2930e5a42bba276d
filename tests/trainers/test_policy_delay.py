"""Policy and targets that move at every second or third update, as in TD3."""

from __future__ import annotations

import functools

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import OfflineTrainer, offline
from torchrl_osr.transforms import StatePerturbation

STEPS = 13


@pytest.fixture
def make(runs):
    """Return a factory of trainers whose policy has a delay."""

    def make(folder, delay: int = 2, **options) -> OfflineTrainer:
        options = {"total_steps": STEPS, "policy_delay": delay} | options
        return runs.make(folder, "CQL", **options)

    return make


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_it_is_a_loop_with_two_optimizers(tmp_path, make, runs, delay) -> None:
    trainer = make(tmp_path, delay)
    torch.manual_seed(3)
    trainer.train()

    loss, data = runs.make_loss("CQL"), runs.make_data("cpu")
    noise = StatePerturbation(0.1, seed=0)
    buffer = make_replay_buffer(data, batch_size=8, seed=0, transform=noise)
    critics = list(loss.qvalue_network_params.parameters())
    known = set(critics)
    others = [each for each in loss.parameters() if each not in known]
    first = torch.optim.Adam(critics, lr=1e-2, fused=True)
    second = torch.optim.Adam(others, lr=1e-2, fused=True)
    targets = SoftUpdate(loss, tau=0.1)
    torch.manual_seed(3)
    for step in range(1, STEPS + 1):
        losses = loss(buffer.sample())
        of_critics = losses["loss_qvalue"] + losses["loss_cql"]
        of_others = sum(losses[f"loss_{x}"] for x in ("actor", "alpha", "alpha_prime"))
        of_critics.backward(inputs=critics, retain_graph=True)
        of_others.backward(inputs=others)
        first.step()
        if step % delay == 0:
            second.step()
            targets.step()
        loss.zero_grad()
    pair = trainer.loss_module.state_dict(), loss.state_dict()
    runs.assert_same_bits(*(each.values() for each in pair))
    counts = {int(each["step"]) for each in trainer.optimizer.state.values()}
    assert counts == {STEPS, STEPS // delay}


def test_killed_and_resumed_it_ends_with_the_same_bits(tmp_path, make, runs) -> None:
    whole = make(tmp_path / "whole", checkpoint_interval=5)
    whole.train()
    folder = tmp_path / "killed"
    for steps in (5, 9, STEPS):
        killed = make(folder, total_steps=steps, checkpoint_interval=5)
        killed.train()
    runs.assert_same_bits(runs.state(killed), runs.state(whole))


def test_recorded_it_has_the_same_bits_and_logs(tmp_path, make, runs, monkeypatch):
    soon = functools.partial(offline.LossGradients, warm_up=2)
    monkeypatch.setattr(offline, "LossGradients", soon)
    found = []
    for record in (False, True):
        numbers = []
        trainer = make(
            tmp_path / str(record), record=record, loggers=[runs.log_of(numbers)]
        )
        trainer.train()
        found.append((runs.state(trainer), numbers))
        both = trainer._stepper.gradients, trainer._stepper.between
        assert [each._recording is not None for each in both] == [record] * 2
    runs.assert_same_bits(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]


def test_there_must_be_something_to_train_in_between(tmp_path, runs) -> None:
    loss = runs.make_loss("inverse dynamics")
    params = list(loss.parameters())
    buffer = make_replay_buffer(runs.make_data("cpu"), batch_size=8, seed=0)
    with pytest.raises(ValueError, match="policy_delay=2 leaves nothing to train"):
        OfflineTrainer(
            loss,
            torch.optim.Adam(params),
            buffer,
            STEPS,
            tmp_path,
            policy_delay=2,
            policy_params=params,
        )


def test_what_is_delayed_must_be_said(tmp_path, runs) -> None:
    with pytest.raises(ValueError, match="policy_delay=2 needs the parameters"):
        runs.make(tmp_path, policy_delay=2, policy_params=())


def test_a_delay_below_one_is_refused(tmp_path, make) -> None:
    with pytest.raises(ValueError, match="policy_delay must be at least 1, got 0"):
        make(tmp_path, 0)
