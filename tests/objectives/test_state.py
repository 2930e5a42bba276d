"""What a loss keeps: parameters, targets, coefficients, and where gradients go."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import (
    LOSSES,
    WRAPPED,
    assert_same_bits,
    call,
    every_loss,
    make_batch,
    make_loss,
    make_networks,
    parts,
    record,
    with_critics,
)
from torch import Tensor
from torchrl.objectives import SoftUpdate


def shift(loss, amount: float = 0.1) -> None:
    """Change every number that the loss keeps."""
    for number, value in enumerate(loss.state_dict().values()):
        if value.is_floating_point():
            value.data.add_(amount * (number % 3 + 1))


@every_loss
def test_state_dict_restores_every_number(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    shift(loss)
    state = copy.deepcopy(loss.state_dict())
    wanted = record(loss, batch)
    assert list(loss.state_dict()) == list(state), "as before the first call"
    fresh, called = (make_loss(name, make_networks(name, seed=9)) for _ in range(2))
    record(called, batch)
    for each in (fresh, called):
        each.load_state_dict(state)
        assert_same_bits(record(each, batch), wanted)


@every_loss
def test_loading_a_state_keeps_the_coefficients_of_the_new_loss(name) -> None:
    old, new, batch = make_loss(name), make_loss(name), make_batch(name, 10)
    for coefficient in new.buffers():
        if not coefficient.ndim and coefficient.is_floating_point():
            coefficient.mul_(0.9)
    wanted = record(new, batch)
    new.load_state_dict(old.state_dict())
    assert_same_bits(record(new, batch), wanted)


def tensors(loss) -> list[Tensor]:
    """Return everything that a loss holds, by every way to it."""
    found = [*loss.parameters(), *loss.buffers(), *loss.state_dict().values()]
    for module in loss.modules():
        found += [each for each in vars(module).values() if isinstance(each, Tensor)]
    return found


@every_loss
def test_every_tensor_moves_with_the_loss(name) -> None:
    """As with another device."""
    loss, batch, there = make_loss(name), make_batch(name, 10), []
    wanted = record(loss, batch)
    loss._apply(lambda tensor: there.append(tensor.clone()) or there[-1])
    addresses = {tensor.data_ptr() for tensor in there}
    assert all(tensor.data_ptr() in addresses for tensor in tensors(loss))
    assert_same_bits(record(loss, batch), wanted)
    shift(loss)
    (fresh := make_loss(name)).load_state_dict(loss.state_dict())
    assert_same_bits(record(loss, batch), record(fresh, batch))
    kinds = {each.dtype for each in tensors(loss.float()) if each.is_floating_point()}
    assert kinds == {torch.float32}


@every_loss
def test_copies_compute_the_same_and_train_apart(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 10)
    wanted, copied = record(loss, batch), copy.deepcopy(loss)
    assert len([*copied.parameters()]) == len([*loss.parameters()])
    assert_same_bits(record(copied, batch), wanted)
    shift(copied)
    assert_same_bits(record(loss, batch), wanted)
    if name in WRAPPED:
        for each in (loss, copied, copied.float()):
            actors = [part.actor_network_params.parameters() for part in parts(each)]
            assert [*map(id, actors[0])] == [*map(id, actors[1])]


@with_critics
def test_targets_follow_and_are_missed_where_nothing_moves_them(name) -> None:
    loss = parts(LOSSES[name].build(make_networks(name)))[0]
    with pytest.warns(UserWarning, match="target network updater"):
        loss(make_batch(name, 10))
    updater = SoftUpdate(loss, tau=0.25)
    targets = [each for each in loss._modules if each.startswith("target_")]
    assert targets
    for target in targets:
        source = loss._modules[target.removeprefix("target_")]
        source.data.apply_(lambda each: each.add_(1.0))
    old = [loss._modules[target].clone() for target in targets]
    updater.step()
    for target, before in zip(targets, old, strict=True):
        for key, value in before.items(True, True):
            found = loss._modules[target][key].data
            torch.testing.assert_close(found, value.data + 0.25)


SCALED = [
    ("osr", "recovery_weight", "loss_actor", "recovery_kl"),
    ("osr", "min_q_weight", "loss_cql", None),
    ("osr-v", "recovery_weight", "loss_qvalue", "recovery_gap"),
    ("discrete", "recovery_weight", "loss_actor", "recovery_kl"),
    ("edac", "diversity_weight", "loss_qvalue", "diversity"),
]


@pytest.mark.parametrize(("name", "weight", "key", "metric"), SCALED)
def test_coefficients_scale_their_terms_and_may_be_assigned(name, weight, key, metric):
    batch, loss = make_batch(name, 10), make_loss(name)
    before, buffer = call(loss, batch), getattr(loss, weight)
    old = buffer.item()
    setattr(loss, weight, 0.0)
    without = call(loss, batch)[key]
    setattr(loss, weight, 3 * old)
    assert getattr(loss, weight) is buffer
    term = before[key] - without
    assert term != 0
    if metric:  # the metric is the term without its weight
        torch.testing.assert_close(term.detach(), old * before[metric])
    torch.testing.assert_close(call(loss, batch)[key], without + 3 * term)


@every_loss
def test_reset_redraws_what_is_trained_and_keeps_frozen_models(name) -> None:
    for loss in parts(make_loss(name)):
        shift(loss, 1000.0)
        held = {key: value.clone() for key, value in loss.state_dict().items()}
        trained = {key for key, _ in loss.named_parameters() if "." in key}
        loss.reset_parameters_recursive()
        for key, value in loss.state_dict().items():
            if key.removeprefix("target_") not in trained:
                assert torch.equal(value, held[key]), key
            elif not key.endswith("state_independent_scale"):  # TorchRL 0.14.1 keeps it
                assert value.abs().max() < 100, key


@every_loss
@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_each_loss_trains_its_own_parameters_and_all_of_them(name, reduction) -> None:
    loss, trains = make_loss(name, reduction=reduction), LOSSES[name].trains
    out = call(loss, make_batch(name, 10))
    names, parameters = zip(*loss.named_parameters(), strict=True)
    owners = [key.removeprefix("loss.").removeprefix("recovery.") for key in names]
    owners = [key.split(".")[0] for key in owners]
    assert set(owners) == set(trains.values())
    assert not any(each.requires_grad for each in loss.buffers())
    assert not any(out[key].requires_grad for key in set(out.keys()) - set(trains))
    for key, group in trains.items():
        slopes = torch.autograd.grad(
            out[key].sum(), parameters, allow_unused=True, retain_graph=True
        )
        for parameter, owner, slope in zip(names, owners, slopes, strict=True):
            if owner != group:
                assert slope is None, (key, parameter)
            # A constant that is added to Q is in both halves of a gap and cancels.
            elif key != "loss_cql" or not parameter.endswith("2.bias"):
                assert slope.abs().max() > 1e-9, (key, parameter)
