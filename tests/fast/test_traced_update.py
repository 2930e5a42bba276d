"""A trace of losses and gradients against the losses themselves."""

from __future__ import annotations

import gc
from unittest import mock

import pytest
import torch
from objectives.losses import A, Networks, S, make_batch, make_loss, make_networks
from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule, set_interaction_type
from torch import nn
from torch.fx.experimental.proxy_tensor import get_proxy_mode
from torchrl.objectives import LossModule

from torchrl_osr import modules
from torchrl_osr.fast import fuse_critics, traced_update
from torchrl_osr.fast.traced_update import LossGradients

LOSSES = ["osr", "cql-options", "osr-v", "edac", "td3-bc", "rebrac", "official", "iql"]
LOSSES += ["osr-v-cql", "rorl", "bc", "model", "discrete"]


def make(name):
    networks = make_networks(name)
    if name == "osr":
        options = {"num_cells": [8, 8], "layer_norm": True}
        critics = modules.critic_ensemble(S, A, **options)
        networks.critics = [each.double() for each in critics]
    loss = make_loss(name, networks)
    fuse_critics(loss)
    return loss


def results(gradients, loss, batch):
    """Losses, gradients, what the loss has written, and the next random number."""
    batch = batch.clone()
    torch.manual_seed(3)
    losses = gradients(batch)
    found = [each.grad for each in loss.parameters()]
    loss.zero_grad()
    return losses, found, batch, torch.rand(())


def assert_same_bits(given, expected) -> None:
    torch.testing.assert_close(given[0], expected[0], rtol=0, atol=0)
    for ours, theirs in zip(given[1], expected[1], strict=True):
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.equal(ours, theirs)
        # A fused optimizer goes through parameter and gradient by address.
        assert ours is None or ours.is_contiguous()
    assert (given[2] == expected[2]).all()
    assert given[3] == expected[3]  # the generator moved on alike


def pair(loss, batch) -> tuple[LossGradients, LossGradients]:
    """The loss as it is and traced."""
    traced = LossGradients(loss, warm_up=1)
    for _ in range(4):
        traced(batch.clone())
    loss.zero_grad()
    return LossGradients(loss, trace=False), traced


def assert_follows(traced, eager, loss, batch) -> None:
    """Compare with the loss after changes of weights and states, which it must read."""
    for _ in range(2):
        batch["observation"] = batch["observation"].flip(0)
        with torch.no_grad():
            for each in loss.parameters():
                each.mul_(1.01)
        expected = results(eager, loss, batch)
        with mock.patch.object(type(loss), "forward", side_effect=AssertionError):
            given = results(traced, loss, batch)
        assert_same_bits(given, expected)


@pytest.mark.parametrize("name", LOSSES)
def test_a_trace_has_the_bits_of_the_loss(name):
    loss, batch = make(name), make_batch(name, 6)
    eager, traced = pair(loss, batch)
    gc.collect()  # the trace owns what it needs
    assert isinstance(traced.trace.run, torch.jit.ScriptModule)
    assert_follows(traced, eager, loss, batch)


def test_wide_networks_have_the_bits_too():
    """TorchScript, optimised, would join the products of two layers and round anew."""
    sizes, cells = (S, A), {"num_cells": [256, 256]}
    networks = Networks()
    networks.actor = modules.tanh_gaussian_actor(*sizes, **cells)
    networks.critics = modules.critic_ensemble(*sizes, **cells)
    networks.model = modules.tanh_gaussian_inverse_dynamics(*sizes, **cells)
    loss, batch = make_loss("osr-v", networks).float(), make_batch("osr", 6)
    eager, traced = pair(loss, batch)
    assert traced.trace
    assert_same_bits(results(traced, loss, batch), results(eager, loss, batch))


def test_another_kind_of_batch_runs_the_loss_itself():
    loss = make("osr")
    eager, traced = pair(loss, make_batch("osr", 6))
    weighted = make_batch("osr", 6)
    weighted["priority_weight"] = torch.rand(6, dtype=torch.float64)
    for batch in (make_batch("osr", 5), weighted, make_batch("osr", 6)):
        assert_same_bits(results(traced, loss, batch), results(eager, loss, batch))
    assert traced.trace


# -- state that changes outside of the traced operations ------------------------------


def first(loss) -> nn.Parameter:
    return next(loss.actor_network_params.parameters())


CHANGES = {
    "weight": lambda loss: setattr(loss, "min_q_weight", 0.1),
    "key": lambda loss: loss.set_keys(reward="other"),
    "gamma": lambda loss: loss.make_value_estimator(gamma=0.5),
    "gamma in place": lambda loss: loss.value_estimator.gamma.fill_(0.5),
    "requires_grad": lambda loss: first(loss).requires_grad_(False),
    "memory": lambda loss: setattr(first(loss), "data", 2 * first(loss).data),
    "hook": lambda loss: loss.register_forward_hook(lambda *each: each[2] * 2),
    "eval": lambda loss: loss.eval(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_changed_later_counts_at_once(change):
    loss = make("osr")
    batch = make_batch("osr", 6)
    batch["next", "other"] = 3 * batch["next", "reward"]
    eager, traced = pair(loss, batch)
    assert traced.trace
    CHANGES[change](loss)
    retrace = change == "weight"
    traced.warm_up = 1 if retrace else 100
    for _ in range(5):
        assert_same_bits(results(traced, loss, batch), results(eager, loss, batch))
    in_place = change == "gamma in place"  # a trace reads tensors anew
    assert (traced.trace is not None) == (retrace or in_place)


def test_modes_of_the_caller_count():
    loss, batch = make("osr").float(), make_batch("osr", 6)
    for context in (
        set_interaction_type(InteractionType.DETERMINISTIC),
        torch.autocast("cpu", torch.bfloat16),
    ):
        eager, traced = pair(loss, batch)
        assert traced.trace
        with context:
            assert_same_bits(results(traced, loss, batch), results(eager, loss, batch))


class Regression(LossModule):
    """A loss of the user's own, with a state that its forward may change."""

    network: TensorDictModule
    network_params: nn.Module
    target_network_params: nn.Module

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind, self.calls, self.weights = kind, 0, [1.0]
        torch.manual_seed(0)
        between = {"batch norm": nn.BatchNorm1d(4), "dropout": nn.Dropout(0.5)}
        layers = nn.Linear(3, 4), between.get(kind, nn.Tanh()), nn.Linear(4, 1)
        network = nn.Sequential(*layers).double()
        module = TensorDictModule(network, ["observation"], ["value"])
        self.convert_to_functional(module, "network", create_target_params=False)
        self.register_buffer("mean", torch.zeros((), dtype=torch.float64))
        self.register_buffer("share", torch.ones((), dtype=torch.float64))

    in_keys, out_keys = ["observation"], ["loss"]

    def forward(self, batch):
        with self.network_params.to_module(self.network):
            value = self.network(batch)["value"]
        weight = self.weights[0]
        if self.kind == "assigned":
            self.mean = 0.9 * self.mean + value.detach().mean()
        elif self.kind == "in place":
            self.mean.mul_(0.9).add_(value.detach().mean())
        elif self.kind == "schedule":
            self.calls += 1
            weight = 1 / self.calls
        elif self.kind == "deciding":
            weight = 2.0 if value.mean() > 0 else 3.0
        elif self.kind == "bare error" and get_proxy_mode() is not None:
            raise NotImplementedError
        elif self.kind == "elsewhere":
            weight = ELSEWHERE[0]
        distance = weight * self.share * (value - 1 + self.mean).square().mean()
        return TensorDict({"loss": distance})


ELSEWHERE = [1.0]
KINDS = ["dropout", "assigned", "in place", "schedule", "batch norm", "deciding"]
KINDS += ["bare error"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_loss_with_a_state_of_its_own_is_not_frozen(kind, caplog):
    one, other, batch = Regression(kind), Regression(kind), make_batch("osr", 6)
    plain, traced = LossGradients(one, trace=False), LossGradients(other, warm_up=3)
    for _ in range(30):
        found = results(traced, other, batch), results(plain, one, batch)
        assert_same_bits(*found)
    assert (traced.trace is not None) == (kind == "dropout")
    assert ("runs without a trace" in caplog.text) != (kind == "dropout")


def test_a_users_own_loss_is_followed():
    loss, batch = Regression("dropout"), make_batch("osr", 6)
    for change in (
        lambda: loss.weights.__setitem__(0, 2.0),
        lambda: setattr(loss, "share", 3 * loss.share),
        lambda: loss.share.mul_(3),
        lambda: loss.network.eval(),
    ):
        eager, traced = pair(loss, batch)
        assert traced.trace
        change()
        assert_same_bits(results(traced, loss, batch), results(eager, loss, batch))


def test_numbers_from_elsewhere_are_found_by_comparison(caplog, monkeypatch):
    monkeypatch.setattr(traced_update, "CHECK_INTERVAL", 10)
    loss, batch = Regression("elsewhere"), make_batch("osr", 6)
    eager, traced = pair(loss, batch)
    monkeypatch.setitem(globals(), "ELSEWHERE", [2.0])
    for _ in range(10):
        last = results(traced, loss, batch)
    assert_same_bits(last, results(eager, loss, batch))
    assert "it reads numbers from outside of its attributes" in caplog.text
