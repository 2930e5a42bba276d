"""What a loss keeps: parameters, targets, coefficients, and where they lie."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn
from torchrl.objectives import SoftUpdate


def values(params) -> list[torch.Tensor]:
    return [tensor.detach().clone() for tensor in params.values(True, True)]


def shift(params, amount: float) -> None:
    for parameter in params.values(True, True):
        if parameter.is_floating_point():  # and no number of a network
            parameter.data.add_(amount)


def held(loss) -> dict[str, torch.Tensor]:
    """The networks' parameters in the loss, targets included, by their names."""
    names = [name for name in loss._modules if name.endswith("_params")]
    return {name: loss._modules[name] for name in names}


def changed(loss, member):
    """The loss with every part of it different from a fresh one's."""
    for i, params in enumerate(held(loss).values()):
        shift(params, 0.1 * (i + 1))
    for weight in member.weights:
        setattr(loss, weight, 1.25)
    for key in ("log_alpha", "log_alpha_prime"):
        if hasattr(loss, key):
            getattr(loss, key).data.fill_(-0.5)
    return loss


@pytest.mark.losses
@pytest.mark.parametrize("source", ["before any call", "after a call"])
@pytest.mark.parametrize("estimator", [True, False], ids=["estimator", "fresh"])
def test_state_dict_restores_every_number(
    family, family_batch, record, assert_same_bits, name, source, estimator
) -> None:
    member, batch = family[name], family_batch(name, 10)
    loss = changed(family(name), member)
    before = loss.state_dict()
    wanted = record(loss, batch)
    assert loss.state_dict().keys() == before.keys()
    fresh = family(name, family.networks(name, seed=9))
    if estimator and family.has(name, "critics"):
        fresh.make_value_estimator(gamma=0.99)
    fresh.load_state_dict(loss.state_dict() if source == "after a call" else before)
    assert_same_bits(record(fresh, batch), wanted)


def tensors(loss) -> list[torch.Tensor]:
    """Everything that the loss holds, by every way to it."""
    found = [*loss.parameters(), *loss.buffers(), *loss.state_dict().values()]
    for params in held(loss).values():
        found += params.values(True, True)
    return found


# What .to(device) does with each tensor. Not .to("meta"), see test_torchrl_defects.
@pytest.mark.losses
def test_every_tensor_moves_with_the_loss(
    family, family_batch, record, assert_same_bits, name
) -> None:
    loss, batch, moved = family(name), family_batch(name, 10), []

    def move(tensor: torch.Tensor) -> torch.Tensor:
        moved.append(tensor.clone())
        return moved[-1]

    wanted = record(loss, batch)
    loss._apply(move)
    there = {tensor.data_ptr() for tensor in moved}
    assert all(tensor.data_ptr() in there for tensor in tensors(loss))
    assert_same_bits(record(loss, batch), wanted)


@pytest.mark.losses
def test_every_number_is_cast_with_the_loss(family, name) -> None:
    loss = family(name).to(torch.float32)
    kinds = {each.dtype for each in tensors(loss) if each.is_floating_point()}
    assert kinds == {torch.float32}


@pytest.mark.losses(having="model")
def test_what_the_model_learns_later_the_loss_knows(
    family, family_batch, seeded, name
) -> None:
    # The example builds the policy's loss before the model is trained, in place.
    model_loss = "discrete-idm" if family[name].discrete else "idm"
    batch, networks = family_batch(name, 10), family.networks(name)
    metric = family[name].recovery_metric
    early = family(name, networks)
    before = seeded(early, batch)[metric]
    shift(family(model_loss, networks).inverse_dynamics_network_params, 0.3)
    after = seeded(early, batch)[metric]
    assert after != before
    assert torch.equal(seeded(family(name, networks), batch)[metric], after)


@pytest.mark.losses(having="critics")
def test_soft_update_moves_targets_a_little(family, name) -> None:
    loss = family(name, updated=False)
    updater = SoftUpdate(loss, tau=0.25)
    old = values(loss.target_qvalue_network_params)
    shift(loss.qvalue_network_params, 1.0)
    updater.step()
    new = values(loss.target_qvalue_network_params)
    for before, after in zip(old, new, strict=True):
        torch.testing.assert_close(after, before + 0.25)


@pytest.mark.losses(having="critics")
def test_forward_warns_when_nothing_moves_the_targets(
    family, family_batch, name
) -> None:
    loss = family(name, updated=False)
    with pytest.warns(UserWarning, match="target network updater"):
        loss(family_batch(name, 10))


@pytest.mark.losses(having="critics")
def test_without_delay_the_online_critics_are_the_target(
    family, family_batch, seeded, name
) -> None:
    batch = family_batch(name, 10)
    loss = family(name, updated=False, delay_qvalue=False)
    before = seeded(loss, batch)["target_value"]
    shift(loss.qvalue_network_params, 0.5)
    assert seeded(loss, batch)["target_value"] != before


@pytest.mark.losses(having="critics")
@pytest.mark.parametrize("count", [1, 3])
def test_a_list_of_critics_keeps_its_weights(family, family_batch, name, count) -> None:
    count = max(count, 2) if name in ("edac", "rorl") else count
    critics = family.networks(name, num_critics=count).critics
    wanted = [list(critic.parameters()) for critic in critics]
    loss = family(name, family.networks(name, num_critics=count))
    stacked = values(loss.qvalue_network_params)
    for i, tensors in enumerate(zip(*wanted, strict=True)):
        assert torch.equal(stacked[i], torch.stack(tensors))
    assert loss.num_qvalue_nets == count
    assert loss(family_batch(name, 10))["loss_qvalue"].isfinite()


@pytest.mark.losses(having="critics")
def test_one_critic_is_copied_as_often_as_asked(family, family_batch, name) -> None:
    networks = family.networks(name)
    networks.critics = networks.critics[0]
    loss = family(name, networks, num_qvalue_nets=4)
    for tensor in values(loss.qvalue_network_params):
        assert tensor.shape[0] == 4
        # TorchRL draws between a tensor's extremes: a single number stays itself.
        assert tensor[0].numel() == 1 or not torch.equal(tensor[0], tensor[1])
    assert loss(family_batch(name, 10))["loss_qvalue"].isfinite()


@pytest.mark.losses(having="weights")
def test_weights_can_be_scheduled_in_place(family, family_batch, seeded, name) -> None:
    loss, batch = family(name), family_batch(name, 10)
    before = seeded(loss, batch)
    for weight, scaled in family[name].weights.items():
        buffer, old = getattr(loss, weight), getattr(loss, weight).item()
        setattr(loss, weight, 0.0)
        without = seeded(loss, batch)
        for factor in (0.0, 2.0, 1.0):
            setattr(loss, weight, factor * old)
            after = seeded(loss, batch)
            assert getattr(loss, weight) is buffer
            assert loss.state_dict()[weight].item() == factor * old
            for key in family[name].out_keys:
                term = before[key] - without[key]
                assert term.any() == (key in scaled)
                expected = without[key] + factor * term
                torch.testing.assert_close(after[key], expected, rtol=1e-12, atol=1e-12)


# Elsewhere a weight of 0 leaves the term out for good.
@pytest.mark.losses("osrv", "recovery", "recovery-plain")
def test_recovery_weight_can_be_scheduled_from_zero(
    family, family_batch, seeded, terms, name
) -> None:
    batch, metric = family_batch(name, 10), family[name].recovery_metric
    loss = family(name, recovery_weight=0.0)
    before = seeded(loss, batch)
    assert not terms(name, loss, batch)["recovery"].any()
    loss.recovery_weight = 2.0
    term = terms(name, loss, batch)["recovery"].detach()
    torch.testing.assert_close(term, 2.0 * before[metric])
    assert torch.equal(seeded(loss, batch)[metric], before[metric])


@pytest.mark.losses
def test_reset_redraws_what_is_trained_and_keeps_a_frozen_model(family, name) -> None:
    loss, groups = family(name), family[name].groups
    for params in held(loss).values():
        shift(params, 1000.0)
    trained, frozen = {}, {}
    for key, params in held(loss).items():
        trains = key.removeprefix("target_") in groups.values()
        (trained if trains else frozen)[key] = params
    assert sorted(frozen) == family[name].frozen
    kept = [values(params) for params in frozen.values()]
    draws = []
    for _ in range(2):
        loss.reset_parameters_recursive()
        draws.append([t for params in trained.values() for t in values(params)])
    assert all(tensor.abs().max() < 100 for tensor in draws[0])
    assert not any(map(torch.equal, *draws))
    for params, old in zip(frozen.values(), kept, strict=True):
        assert all(map(torch.equal, values(params), old))


def with_dropout(networks):
    """Critics of equal weights that differ in nothing but their masks."""
    networks.critics[0].module.insert(1, nn.Dropout(0.5))
    networks.critics = [copy.deepcopy(networks.critics[0]) for _ in networks.critics]
    return networks


@pytest.mark.losses(having="critics")
def test_randomness_of_vmap_can_be_chosen(family, family_batch, name) -> None:
    networks = with_dropout(family.networks(name))
    loss, batch = family(name, networks), family_batch(name, 10)
    states = batch.select(*loss.qvalue_network.in_keys)
    key = loss.qvalue_network.out_keys[-1]
    assert loss.vmap_randomness == "different"
    for randomness in ("different", "same"):
        loss.set_vmap_randomness(randomness)
        assert loss(batch)["loss_qvalue"].isfinite()
        found = loss._vmap_qvalue(states.copy(), loss.qvalue_network_params)[key]
        assert torch.equal(found[0], found[1]) == (randomness == "same")
    loss.set_vmap_randomness("error")
    with pytest.raises(RuntimeError, match="randomness"):
        loss(batch)
    with pytest.raises(ValueError, match="should be one of"):
        loss.set_vmap_randomness("some")
