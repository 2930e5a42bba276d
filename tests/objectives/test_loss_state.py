"""What a loss keeps: parameters, targets, coefficients, the value estimator."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torchrl.objectives import HardUpdate, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss

MODES = ["osr", "cql", "osrv"]
RECOVERING = ["osr", "osrv"]


def build(mode: str, networks, **kwargs) -> OSRLoss | OSRVLoss:
    loss_class = OSRVLoss if mode == "osrv" else OSRLoss
    return loss_class(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        recovery_weight=0.0 if mode == "cql" else 0.5,
        num_random=3,
        **kwargs,
    ).double()


def updated(mode: str, networks, **kwargs) -> OSRLoss | OSRVLoss:
    loss = build(mode, networks, **kwargs)
    SoftUpdate(loss, tau=0.1)
    return loss


def seeded(loss, batch):
    torch.manual_seed(2)
    return loss(batch)


def values(params) -> list[torch.Tensor]:
    return [tensor.detach().clone() for tensor in params.values(True, True)]


def shift(params, amount: float) -> None:
    for parameter in params.values(True, True):
        parameter.data.add_(amount)


def saved_after_a_change(mode: str, networks, batch):
    """State and numbers of a loss whose every part differs from a fresh one's."""
    loss = updated(mode, networks)
    shift(loss.actor_network_params, 0.1)
    shift(loss.qvalue_network_params, 0.2)
    shift(loss.target_qvalue_network_params, 0.3)
    if mode in RECOVERING:
        shift(loss.inverse_dynamics_network_params, 0.4)
    setattr(loss, "recovery_weight" if mode == "osrv" else "min_q_weight", 1.25)
    loss.log_alpha.data.fill_(-0.5)
    return loss.state_dict(), seeded(loss, batch), loss.state_dict()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("source", ["before any call", "after a call"])
@pytest.mark.parametrize("estimator", [True, False], ids=["estimator", "fresh"])
def test_state_dict_restores_every_number(
    make_networks, make_batch, mode, source, estimator
) -> None:
    batch = make_batch(10)
    before, wanted, after = saved_after_a_change(mode, make_networks(), batch)
    fresh = updated(mode, make_networks(seed=9))
    if estimator:
        fresh.make_value_estimator(gamma=0.99)
    fresh.load_state_dict(after if source == "after a call" else before)
    out = seeded(fresh, batch)
    for key in wanted.keys():  # noqa: SIM118
        assert torch.equal(out[key], wanted[key]), key


def test_state_dict_of_the_model_loss_restores_it(make_networks, make_batch) -> None:
    loss = InverseDynamicsLoss(make_networks().inverse_dynamics)
    fresh = InverseDynamicsLoss(make_networks(seed=9).inverse_dynamics)
    fresh.load_state_dict(loss.state_dict())
    batch, key = make_batch(10), "loss_inverse_dynamics"
    assert torch.equal(fresh(batch)[key], loss(batch)[key])


@pytest.mark.parametrize("mode", RECOVERING)
def test_a_trained_model_loss_hands_its_model_over(
    make_networks, make_batch, mode
) -> None:
    # The recovery term reads the network that InverseDynamicsLoss trained in place.
    networks = make_networks()
    shift(
        InverseDynamicsLoss(networks.inverse_dynamics).inverse_dynamics_network_params,
        0.3,
    )
    trained = updated(mode, networks)
    untrained = updated(mode, make_networks())
    batch = make_batch(10)
    assert (
        seeded(trained, batch)["loss_recovery"]
        != (seeded(untrained, batch)["loss_recovery"])
    )


@pytest.mark.parametrize("mode", MODES)
def test_soft_update_moves_targets_a_little(make_networks, mode) -> None:
    loss = build(mode, make_networks())
    updater = SoftUpdate(loss, tau=0.25)
    old = values(loss.target_qvalue_network_params)
    shift(loss.qvalue_network_params, 1.0)
    updater.step()
    new = values(loss.target_qvalue_network_params)
    for before, after in zip(old, new, strict=True):
        torch.testing.assert_close(after, before + 0.25)


@pytest.mark.parametrize("mode", MODES)
def test_hard_update_copies_at_its_interval(make_networks, mode) -> None:
    loss = build(mode, make_networks())
    updater = HardUpdate(loss, value_network_update_interval=2)
    shift(loss.qvalue_network_params, 1.0)
    equal = []
    for _ in range(3):
        updater.step()
        target = values(loss.target_qvalue_network_params)
        online = values(loss.qvalue_network_params)
        equal.append(all(map(torch.equal, target, online)))
    assert equal == [False, False, True]  # TorchRL counts two steps, then copies


@pytest.mark.parametrize("mode", MODES)
def test_forward_warns_when_nothing_moves_the_targets(
    make_networks, make_batch, mode
) -> None:
    loss = build(mode, make_networks())
    with pytest.warns(UserWarning, match="target network updater"):
        loss(make_batch(10))


def test_without_delay_the_online_critics_are_the_target(
    make_networks, make_batch
) -> None:
    loss, batch = build("cql", make_networks(), delay_qvalue=False), make_batch(10)
    before = seeded(loss, batch)["target_value"]
    shift(loss.qvalue_network_params, 0.5)
    assert seeded(loss, batch)["target_value"] != before


@pytest.mark.parametrize("count", [1, 3])
def test_a_list_of_critics_keeps_its_weights(make_networks, count) -> None:
    critics = make_networks(num_critics=count).critics
    wanted = [list(critic.parameters()) for critic in critics]
    loss = build("osr", make_networks(num_critics=count))
    stacked = values(loss.qvalue_network_params)
    for i, tensors in enumerate(zip(*wanted, strict=True)):
        assert torch.equal(stacked[i], torch.stack(tensors))


def test_one_critic_is_copied_as_often_as_asked(make_networks) -> None:
    networks = make_networks()
    networks.critics = networks.critics[0]
    loss = build("osr", networks, num_qvalue_nets=4)
    for tensor in values(loss.qvalue_network_params):
        assert tensor.shape[0] == 4
        # TorchRL draws between a tensor's extremes: a single number stays itself.
        assert tensor[0].numel() == 1 or not torch.equal(tensor[0], tensor[1])


def test_weights_can_be_scheduled_in_place(make_networks, make_batch) -> None:
    loss, batch = updated("osr", make_networks()), make_batch(10)
    before = seeded(loss, batch)
    buffer = loss.recovery_weight
    loss.recovery_weight = 0.1
    loss.min_q_weight = 10.0
    after = seeded(loss, batch)
    assert loss.recovery_weight is buffer
    assert loss.state_dict()["recovery_weight"].item() == pytest.approx(0.1)
    for key, factor in {
        "loss_recovery": 0.1 / 0.5,
        "loss_cql": 10.0 / 5.0,
        "loss_actor": 1.0,
        "recovery_kl": 1.0,
    }.items():
        torch.testing.assert_close(after[key], factor * before[key])


def test_weight_of_the_value_constraint_can_be_scheduled_from_zero(
    make_networks, make_batch
) -> None:
    loss, batch = updated("osrv", make_networks()), make_batch(10)
    before = seeded(loss, batch)
    buffer = loss.recovery_weight
    for weight in (0.0, 2.0):
        loss.recovery_weight = weight
        after = seeded(loss, batch)
        assert loss.recovery_weight is buffer
        assert loss.state_dict()["recovery_weight"].item() == weight
        expected = weight / 0.5 * before["loss_recovery"]
        torch.testing.assert_close(after["loss_recovery"], expected)
        for key in ("loss_actor", "loss_qvalue", "recovery_gap"):
            assert torch.equal(after[key], before[key])


def with_estimator(networks, batch, *args, mode="cql", **kwargs) -> torch.Tensor:
    loss = updated(mode, networks)
    loss.make_value_estimator(*args, **kwargs)
    return seeded(loss, batch)["target_value"]


@pytest.mark.parametrize("mode", MODES)
def test_the_kinds_of_target_agree_where_they_must(
    make_networks, make_batch, mode
) -> None:
    target = partial(with_estimator, make_networks(), make_batch(2, 5), mode=mode)
    td0 = target()
    assert td0 == target("td0", gamma=0.99)
    assert td0 == target(ValueEstimators.TD0)
    assert td0 == target(TD0Estimator(gamma=0.99, value_network=None))
    td1 = target(ValueEstimators.TD1)
    assert td0 != td1
    # TD(lambda) is TD(0) at lambda = 0 and TD(1) at lambda = 1.
    for lmbda, wanted in {0.0: td0, 1.0: td1}.items():
        # The vectorised estimator of TorchRL 0.14.1 fails at lambda = 0.
        found = target(ValueEstimators.TDLambda, lmbda=lmbda, vectorized=False)
        torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize("mode", RECOVERING)
@pytest.mark.parametrize("kind", ["gae", ValueEstimators.GAE, ValueEstimators.VTrace])
def test_estimators_without_an_action_value_are_refused(
    make_networks, mode, kind
) -> None:
    with pytest.raises(NotImplementedError):
        build(mode, make_networks()).make_value_estimator(kind)


def test_gamma_scales_the_bootstrap(make_networks, make_batch) -> None:
    networks, batch = make_networks(), make_batch(10)
    zero, half, one = (
        with_estimator(networks, batch, gamma=gamma) for gamma in (0.0, 0.5, 1.0)
    )
    torch.testing.assert_close(zero, batch["next", "reward"].mean())
    assert one != zero
    torch.testing.assert_close(half, (zero + one) / 2)


@pytest.mark.parametrize("mode", MODES)
def test_reset_redraws_what_is_trained_and_keeps_the_frozen_model(
    make_networks, mode
) -> None:
    loss = updated(mode, make_networks())
    names = ["actor_network", "qvalue_network", "target_qvalue_network"]
    for name in names:
        shift(getattr(loss, f"{name}_params"), 1000.0)
    recovers = mode in RECOVERING
    model = values(loss.inverse_dynamics_network_params) if recovers else []
    loss.reset_parameters_recursive()
    for name in names:
        for tensor in values(getattr(loss, f"{name}_params")):
            assert tensor.abs().max() < 100, name
    if recovers:
        kept = values(loss.inverse_dynamics_network_params)
        assert all(map(torch.equal, kept, model))
