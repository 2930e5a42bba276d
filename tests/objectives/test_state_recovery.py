"""StateRecoveryLoss by itself and beside TorchRL's own losses."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import IQLLoss, SACLoss, SoftUpdate, TD3BCLoss

from torchrl_osr import StateRecoveryLoss

KEY, METRIC, ACTOR = "loss_recovery", "recovery_kl", "actor_network_params"
NEXT, PERTURBED = ("next", "observation"), ("perturbed", "observation")
REVERSE = {"recovery_direction": "reverse"}
STATES = ["both", "clean", "perturbed"]
BOUNDS = [([-1.0, -1.0], [1.0, 1.0]), ([-1.0, -0.5], [2.0, 1.5])]


def double(low, high) -> dict[str, Tensor]:
    return {"low": torch.tensor(low).double(), "high": torch.tensor(high).double()}


def make_loss(networks, **kwargs) -> StateRecoveryLoss:
    model = networks.inverse_dynamics
    return StateRecoveryLoss(networks.actor, model, **kwargs).double()


def value_and_gradients(loss, batch, key: str = KEY) -> list[Tensor]:
    torch.manual_seed(2)
    value = loss(batch)[key]
    actor = list(loss.actor_network_params.parameters())
    return [value.detach(), *torch.autograd.grad(value.sum(), actor)]


class Restatement:
    """The term once more, with torch.distributions alone, over rows that count."""

    def __init__(self, batch, states: str) -> None:
        kept = ~batch["next", "done"].squeeze(-1)
        sets = {"clean": batch["observation"], "perturbed": batch[PERTURBED]}
        names = ["clean", "perturbed"] if states == "both" else [states]
        self.states = torch.stack([sets[name][kept] for name in names])
        self.following = batch[NEXT][kept].expand_as(self.states)

    def model(self, network) -> Normal:
        with torch.no_grad():
            _, loc, scale = network[0](self.states, self.following)
        return Normal(loc, scale)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.parametrize("states", STATES)
def test_value_and_gradients_equal_the_divergence_of_torch(
    make_networks, make_batch, check, direction, reduction, states
) -> None:
    networks, batch = make_networks(**double(*BOUNDS[1])), make_batch(10)
    options = {
        "recovery_direction": direction,
        "action_reduction": reduction,
        "recovery_states": states,
    }
    loss = make_loss(copy.deepcopy(networks), recovery_weight=0.75, **options)
    restated = Restatement(batch, states)
    model = restated.model(networks.inverse_dynamics)
    policy = Normal(*networks.actor[0](restated.states)[1:])
    pair = (model, policy) if direction == "forward" else (policy, model)
    expected = 0.75 * getattr(kl_divergence(*pair), reduction)(-1).mean()
    gradients = torch.autograd.grad(expected, list(networks.actor.parameters()))
    metric = loss(batch)[METRIC]
    assert not metric.requires_grad
    got = [*value_and_gradients(loss, batch), metric]
    wanted = [expected.detach(), *gradients, expected.detach() / 0.75]
    check("State recovery alone", got, wanted, tolerance=1e-12)


@pytest.mark.parametrize("kind", ["delta", "actor", "module"])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
@pytest.mark.parametrize("states", STATES)
def test_deterministic_actors_are_measured_before_the_tanh(
    make_networks,
    make_deterministic_actor,
    make_batch,
    check,
    kind,
    low,
    high,
    states,
) -> None:
    bounds, batch = double(low, high), make_batch(10)
    model_network = make_networks(**bounds).inverse_dynamics
    actor, plain = (make_deterministic_actor(kind, **bounds) for _ in range(2))
    options = {"recovery_states": states, "recovery_weight": 0.75} | REVERSE
    loss = StateRecoveryLoss(actor, model_network, **options).double()
    restated = Restatement(batch, states)
    model = restated.model(model_network)
    mlp = plain.module[0].module if kind == "delta" else plain.module[0]
    x = mlp(restated.states)
    if kind == "delta":  # TorchRL moves a TanhDelta's parameter by the center
        x = x + (bounds["low"] + bounds["high"]) / 2
    expected = ((x - model.loc) ** 2 / (2 * model.scale**2)).sum(-1).mean()
    gradients = torch.autograd.grad(0.75 * expected, list(plain.parameters()))
    got = value_and_gradients(loss, batch)
    wanted = [0.75 * expected.detach(), *gradients]
    check("State recovery alone", got, wanted, tolerance=1e-12)
    # And the pre-tanh action is that of the action which the actor takes.
    action = actor(batch.select("observation"))["action"]
    squashed = 2 * (action - bounds["low"]) / (bounds["high"] - bounds["low"]) - 1
    x = mlp(batch["observation"]) + (kind == "delta") * (low[0] + high[0]) / 2
    torch.testing.assert_close(torch.atanh(squashed), x)


@pytest.mark.parametrize("kind", ["delta", "actor", "raw"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_is_finite_where_the_action_has_saturated(
    make_networks, make_deterministic_actor, make_batch, kind, dtype
) -> None:
    actor = make_deterministic_actor("delta" if kind == "delta" else "actor").to(dtype)
    if kind == "raw":
        actor.module[1] = nn.Identity()  # no tanh at all: actions out of bounds
    last = list(actor.parameters())[-1]
    last.data.fill_(40.0)
    model = make_networks().inverse_dynamics.to(dtype)
    loss = StateRecoveryLoss(actor, model, **REVERSE).to(dtype)
    batch = make_batch(10).apply(lambda t: t.to(dtype) if t.is_floating_point() else t)
    gradients = value_and_gradients(loss, batch)
    assert all(gradient.isfinite().all() for gradient in gradients)
    # A tanh that has saturated lets nothing through; the others pull the action back.
    assert (gradients[-1] > 0).all() == (kind != "actor")


def other_loss(other: str, networks, make_deterministic_actor):
    """A loss of TorchRL's and the actor in it."""
    actor, critics = networks.actor, networks.critics
    if other == "iql":
        value = ValueOperator(MLP(3, 1, num_cells=[8]), ["observation"]).double()
        loss = IQLLoss(actor, critics, value)
    elif other == "sac":
        loss = SACLoss(actor, critics, target_entropy=-2.0)
    else:
        actor = make_deterministic_actor(other.removeprefix("td3bc-"))
        loss = TD3BCLoss(actor, critics, bounds=(-1.0, 1.0))
    loss = loss.double()
    loss.make_value_estimator(gamma=0.9)
    SoftUpdate(loss, tau=0.1)
    return loss, actor


def backward(losses, parameters) -> list[Tensor]:
    """Gradients of one backward over the summed losses, zeros where there is none."""
    for parameter in parameters:
        parameter.grad = None
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    return [
        torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        for parameter in parameters
    ]


@pytest.mark.parametrize("kind", ["iql", "sac", "td3bc-delta", "td3bc-actor"])
@pytest.mark.parametrize("order", [1, -1], ids=["after", "before"])
def test_one_summed_backward_gives_the_actor_both_gradients_and_others_one(
    make_networks, make_deterministic_actor, make_batch, kind, order
) -> None:
    networks, batch = make_networks(), make_batch(10)
    other, actor = other_loss(kind, networks, make_deterministic_actor)
    direction = "reverse" if kind.startswith("td3") else "forward"
    model = networks.inverse_dynamics
    recovery = StateRecoveryLoss(actor, model, recovery_direction=direction).double()
    assert set(recovery.parameters()) == set(actor.parameters())
    assert set(recovery.parameters()) <= set(other.parameters())

    names, parameters = zip(*other.named_parameters(), strict=True)
    terms = []
    for loss in (other, recovery):
        torch.manual_seed(2)
        terms.append(backward(loss(batch.clone()), parameters))
    torch.manual_seed(2)
    losses: dict[str, Tensor] = {}
    for loss in (other, recovery)[::order]:
        losses |= {**loss(batch)}
    summed = backward(losses, parameters)
    for key, both, base, extra in zip(names, summed, *terms, strict=True):
        if key.startswith(ACTOR):
            assert extra.abs().max() > 0, key
            torch.testing.assert_close(both, base + extra, rtol=1e-12, atol=1e-12)
        else:
            assert torch.equal(both, base), key
            assert not extra.any(), key
    assert all(parameter.grad is None for parameter in model.parameters())


def test_sharing_survives_a_cast_and_a_step(
    make_networks, make_deterministic_actor, make_batch
) -> None:
    networks = make_networks()
    iql, actor = other_loss("iql", networks, make_deterministic_actor)
    recovery = StateRecoveryLoss(actor, networks.inverse_dynamics)
    iql.float(), recovery.float()
    assert set(recovery.parameters()) <= set(iql.parameters())
    batch = make_batch(10).float()
    batch["next", "done"] = batch["next", "done"].bool()
    optimizer = torch.optim.SGD(iql.parameters(), lr=1e-2)
    before = recovery(batch)[KEY]
    before.backward()
    optimizer.step()
    assert recovery(batch)[KEY] < before


@pytest.mark.parametrize("states", STATES)
def test_states_decide_what_is_read(make_networks, make_batch, states) -> None:
    loss, batch = make_loss(make_networks(), recovery_states=states), make_batch(10)
    perturbed = [] if states == "clean" else [PERTURBED]
    assert loss.in_keys == ["observation", NEXT, ("next", "done"), *perturbed]
    assert loss.out_keys == [KEY, METRIC]
    out = loss(batch.select(*loss.in_keys))
    assert list(out.keys()) == loss.out_keys
    inputs = {
        "_".join([*[key]] if isinstance(key, str) else key): batch[key]
        for key in loss.in_keys
    }
    assert torch.equal(loss(**inputs)[0], out[KEY])
    assert set(batch.keys(True, True)) == set(make_batch(10).keys(True, True))


def test_states_that_only_the_model_reads_are_asked_for(
    make_networks, make_batch
) -> None:
    networks, batch = make_networks(), make_batch(10)
    networks.inverse_dynamics = make_networks(observation="goal").inverse_dynamics
    for group in (batch, batch["next"], batch["perturbed"]):
        group["goal"] = group["observation"]
    loss = make_loss(networks)
    for key in ("goal", ("next", "goal"), ("perturbed", "goal")):
        assert key in loss.in_keys
    expected = make_loss(make_networks())(make_batch(10))[KEY]
    assert torch.equal(loss(batch.select(*loss.in_keys))[KEY], expected)


@pytest.mark.parametrize("kind", ["delta", "actor", "module"])
def test_direction_follows_from_the_actor(
    make_networks, make_deterministic_actor, kind
) -> None:
    networks = make_networks()
    model, actor = networks.inverse_dynamics, make_deterministic_actor(kind)
    assert StateRecoveryLoss(networks.actor, model).recovery_direction == "forward"
    assert StateRecoveryLoss(actor, model).recovery_direction == "reverse"
    with pytest.raises(
        ValueError, match="deterministic.*Pass recovery_direction='reverse'"
    ):
        StateRecoveryLoss(actor, model, recovery_direction="forward")


def gaussian_actor() -> ProbabilisticActor:
    """A Gaussian around a tanh, without one at its end, float64."""
    torch.manual_seed(0)
    network = nn.Sequential(
        MLP(3, 2, num_cells=[8]), nn.Tanh(), AddStateIndependentNormalScale(2)
    )
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=IndependentNormal,
    ).double()


@pytest.mark.parametrize("states", STATES)
def test_mean_of_a_gaussian_is_measured_before_its_tanh(
    make_networks, make_batch, check, states
) -> None:
    network, batch = make_networks().inverse_dynamics, make_batch(10)
    actor, plain = gaussian_actor(), gaussian_actor()
    options = {"recovery_states": states, "recovery_weight": 0.75}
    loss = StateRecoveryLoss(actor, network, **options).double()
    restated = Restatement(batch, states)
    model, x = restated.model(network), plain.module[0].module[0](restated.states)
    expected = ((x - model.loc) ** 2 / (2 * model.scale**2)).sum(-1).mean()
    mean = list(plain.module[0].module[0].parameters())
    gradients = torch.autograd.grad(0.75 * expected, mean)
    loss(batch)[KEY].backward()
    got = [loss(batch)[KEY].detach()]
    grads = [each.grad for each in loss.actor_network_params.parameters()]
    got += [each for each in grads if each is not None]  # not of the scale
    wanted = [0.75 * expected.detach(), *gradients]
    check("State recovery alone", got, wanted, tolerance=1e-10)


@pytest.mark.parametrize("kind", ["tanh", "gaussian", "delta", "actor", "module"])
@pytest.mark.parametrize("states", STATES)
@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_the_datas_action_may_be_the_target(
    make_networks, make_deterministic_actor, make_batch, check, kind, states, reduction
) -> None:
    make = {
        "tanh": lambda: make_networks().actor,
        "gaussian": gaussian_actor,
    }.get(kind, lambda: make_deterministic_actor(kind))
    actor, plain, batch = make(), make(), make_batch(10)
    options = {"recovery_states": states, "action_reduction": reduction}
    loss = StateRecoveryLoss(
        actor, recovery_target="data", recovery_weight=0.75, **options
    ).double()
    restated = Restatement(batch, states)
    kept = ~batch["next", "done"].squeeze(-1)
    action = batch["action"][kept].expand(len(restated.states), -1, -1)
    if kind == "tanh":
        z = action.atanh()
        density = Normal(*plain.module[0](restated.states)[1:])
        log_prob = density.log_prob(z) - (1 - action**2).log()
        expected = -getattr(log_prob, reduction)(-1).mean()
    elif kind == "gaussian":
        density = Normal(*plain.module[0].module(restated.states))
        expected = -getattr(density.log_prob(action), reduction)(-1).mean()
    else:
        mlp = plain.module[0].module if kind == "delta" else plain.module[0]
        error = (torch.tanh(mlp(restated.states)) - action) ** 2
        expected = getattr(error, reduction)(-1).mean()
    gradients = torch.autograd.grad(0.75 * expected, list(plain.parameters()))
    wanted = [0.75 * expected.detach(), *gradients, expected.detach()]
    (metric,) = set(loss.out_keys) - {KEY}
    assert metric == "recovery_" + ("nll" if kind in ("tanh", "gaussian") else "error")
    got = [*value_and_gradients(loss, batch), loss(batch)[metric]]
    check("Noisy cloning alone", got, wanted, tolerance=1e-10)
    assert not [key for key in loss.in_keys if "next" in key and "done" not in key]
    batch["steps_to_next_obs"] = torch.full((10, 1), 5)
    torch.testing.assert_close(value_and_gradients(loss, batch), got[:-1])


def test_a_model_is_needed_unless_the_data_are_the_target(make_networks) -> None:
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        StateRecoveryLoss(make_networks().actor)
