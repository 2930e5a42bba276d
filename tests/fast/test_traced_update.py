"""A recording of losses and gradients against the losses themselves."""

from __future__ import annotations

import gc

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_osr import (
    CQLLoss,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StateRecoveryLoss,
)
from torchrl_osr.fast.traced_update import LossGradients
from torchrl_osr.lab.losses import (
    BCLoss,
    EDACLoss,
    IQLLoss,
    ReBRACLoss,
    RORLLoss,
    TD3BCLoss,
)
from torchrl_osr.modules import (
    critic_ensemble,
    deterministic_actor,
    gaussian_actor,
    state_value,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.objectives import WithRecovery

SIZES = (3, 2)
CELLS = {"num_cells": [8, 8]}


def networks(actor=tanh_gaussian_actor, **options):
    return actor(*SIZES, **CELLS), critic_ensemble(*SIZES, **CELLS, **options)


def model():
    return tanh_gaussian_inverse_dynamics(*SIZES, **CELLS)


def with_recovery(loss, recovery):
    SoftUpdate(loss, tau=0.1)  # TorchRL warns of losses without one
    return WithRecovery(loss, recovery)


LOSSES = {
    "osr": lambda: OSRLoss(*networks(layer_norm=True), model(), num_random=2),
    "cql": lambda: CQLLoss(*networks(), target_action_gap=0.0),
    "osr_v": lambda: OSRVLoss(*networks(), model(), num_random=2),
    "edac": lambda: EDACLoss(*networks()),
    "td3_bc": lambda: TD3BCLoss(*networks(deterministic_actor)),
    "rebrac": lambda: ReBRACLoss(*networks(deterministic_actor, layer_norm=True)),
    "rebrac+osr": lambda: with_recovery(
        ReBRACLoss(actor := networks(deterministic_actor)[0], networks()[1]),
        StateRecoveryLoss(actor, model()),
    ),
    "iql": lambda: IQLLoss(*networks(gaussian_actor), state_value(SIZES[0], **CELLS)),
    "rorl": lambda: RORLLoss(*networks(), num_samples=2),
    "bc": lambda: BCLoss(networks()[0]),
    "inverse_dynamics": lambda: InverseDynamicsLoss(model()),
}


@pytest.fixture
def make_batch(make_batch):
    """Return a factory of batches that any loss can read."""

    def make(*size, **options):
        batch = make_batch(*size, **options)
        batch["next", "action"] = batch["action"].flip(0)
        return batch

    return make


def make(name):
    loss = LOSSES[name]().double()
    if hasattr(loss, "qvalue_network"):
        SoftUpdate(loss, tau=0.1)  # TorchRL warns of losses without one
    return loss


def results(gradients, loss, batch):
    """Losses, gradients and what the loss has written, for one state of the noise."""
    batch = batch.clone()
    torch.manual_seed(3)
    losses = gradients(batch)
    found = [each.grad for each in loss.parameters()]
    loss.zero_grad()
    return losses, found, batch, torch.rand(())


@pytest.mark.parametrize("name", LOSSES)
def test_a_recording_has_the_bits_of_what_was_recorded(name, make_batch):
    loss = make(name)
    eager, recorded = LossGradients(loss), LossGradients(loss, record=True, warm_up=0)
    recorded(make_batch(6, twin=True))
    gc.collect()  # the recording owns what it needs
    loss.zero_grad()
    assert isinstance(recorded._recording.run, torch.jit.ScriptModule)
    calls = []
    loss.register_forward_pre_hook(lambda *_: calls.append(1))
    for seed in (1, 2):
        torch.manual_seed(seed)
        batch = make_batch(6, twin=True)
        with torch.no_grad():
            for each in loss.parameters():
                each.mul_(1.01)
        expected = results(eager, loss, batch)
        calls.clear()
        given = results(recorded, loss, batch)
        assert not calls  # the loss's own code was not run
        torch.testing.assert_close(given[0], expected[0], rtol=0, atol=0)
        for ours, theirs in zip(given[1], expected[1], strict=True):
            assert (ours is None) == (theirs is None)
            assert ours is None or torch.equal(ours, theirs)
            # A fused optimizer goes through parameter and gradient by address.
            assert ours is None or ours.is_contiguous()
        assert (given[2] == expected[2]).all()
        assert given[3] == expected[3]  # the generator moved on alike
    assert all(each is not None for each in given[1])


def test_another_kind_of_batch_or_option_runs_the_loss_itself(make_batch):
    loss = make("osr")
    recorded = LossGradients(loss, record=True, warm_up=0)
    recorded(make_batch(6, twin=True))
    calls = []
    loss.register_forward_pre_hook(lambda *_: calls.append(1))
    recorded(make_batch(6, twin=True))
    assert not calls
    recorded(make_batch(5, twin=True))
    assert calls == [1]
    weighted = make_batch(6, twin=True)
    weighted["priority_weight"] = torch.rand(6, dtype=torch.float64)
    recorded(weighted)
    assert calls == [1, 1]
    loss.num_random = 3
    recorded(make_batch(6, twin=True))
    assert calls == [1, 1, 1]


def test_a_loss_that_decides_by_numbers_is_run_as_it_is(make_batch, caplog):
    class Deciding(CQLLoss):
        def forward(self, tensordict):
            if (tensordict["action"] > 0).any():
                return super().forward(tensordict)
            raise AssertionError

    loss = Deciding(*networks()).double()
    SoftUpdate(loss, tau=0.1)
    batch = make_batch(6)
    for gradients in (LossGradients(loss, record=True, warm_up=0), LossGradients(loss)):
        losses, found, *_ = results(gradients, loss, batch)
    assert "Deciding runs without a recording" in caplog.text
    assert all(value.isfinite() for value in losses.values())
    assert sum(each is not None for each in found) > 4


def test_the_same_weights_are_trained_by_a_fused_optimizer(make_batch):
    batch, trained = make_batch(6, twin=True), []
    for record in (False, True):
        torch.manual_seed(0)
        loss = make("osr")
        gradients = LossGradients(loss, record=record, warm_up=0)
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
        for _ in range(3):
            gradients(batch.clone())
            optimizer.step()
            optimizer.zero_grad()
        trained.append(loss.state_dict().values())
    assert all(torch.equal(*pair) for pair in zip(*trained, strict=True))
