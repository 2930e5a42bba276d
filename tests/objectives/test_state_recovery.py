"""StateRecoveryLoss by itself and beside TorchRL's own losses."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import unravel_key
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torchrl.modules import (
    MLP,
    Actor,
    ProbabilisticActor,
    TanhDelta,
    TruncatedNormal,
    ValueOperator,
)
from torchrl.objectives import IQLLoss, SACLoss, SoftUpdate, TD3BCLoss

from torchrl_osr import OSRLoss, StateRecoveryLoss

KEY, METRIC, ACTOR = "loss_recovery", "recovery_kl", "actor_network_params"
NEXT, TWIN = ("next", "observation"), ("perturbed", "observation")
STATES = ["both", "clean", "perturbed"]
BOUNDS = [([-1.0, -1.0], [1.0, 1.0]), ([-1.0, -0.5], [2.0, 1.5])]


def double(low, high) -> dict[str, Tensor]:
    return {"low": torch.tensor(low).double(), "high": torch.tensor(high).double()}


class Squash(nn.Module):
    """The last layer of a plain actor: a tanh and the action's bounds."""

    def __init__(self, low=-1.0, high=1.0) -> None:
        super().__init__()
        self.center, self.half = (high + low) / 2, (high - low) / 2

    def forward(self, value: Tensor) -> Tensor:
        return self.center + self.half * torch.tanh(value)


def deterministic_actor(kind: str, *, action="action", seed: int = 0, **bounds):
    torch.manual_seed(seed)
    mlp = MLP(3, 2, num_cells=[8])
    if kind == "delta":
        return ProbabilisticActor(
            TensorDictModule(mlp, ["observation"], ["param"]),
            in_keys=["param"],
            out_keys=[action],
            distribution_class=TanhDelta,
            distribution_kwargs=bounds,
        ).double()
    network = nn.Sequential(mlp, Squash(**bounds))
    actor_class = Actor if kind == "actor" else TensorDictModule
    return actor_class(network, in_keys=["observation"], out_keys=[action]).double()


def make_loss(networks, kind: str = "gaussian", **kwargs) -> StateRecoveryLoss:
    actor = networks.actor
    if kind != "gaussian":
        actor = deterministic_actor(kind)
        kwargs["direction"] = "reverse"
    return StateRecoveryLoss(actor, networks.inverse_dynamics, **kwargs).double()


KINDS = ["gaussian", "delta", "actor"]


def value_and_gradients(loss, batch) -> list[Tensor]:
    value = loss(batch)[KEY]
    return [value.detach(), *torch.autograd.grad(value.sum(), list(loss.parameters()))]


def assert_same(got, wanted, tolerance: float = 1e-12) -> None:
    for ours, theirs in zip(got, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)


class Restatement:
    """The term once more, with torch.distributions alone, over rows that count."""

    def __init__(self, batch, states: str) -> None:
        kept = ~batch["next", "done"].squeeze(-1)
        sets = {"clean": batch["observation"], "perturbed": batch[TWIN]}
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
    make_networks, make_batch, direction, reduction, states
) -> None:
    networks, batch = make_networks(**double(*BOUNDS[1])), make_batch(10)
    options = {"direction": direction, "action_reduction": reduction, "states": states}
    loss = make_loss(copy.deepcopy(networks), recovery_weight=0.75, **options)
    restated = Restatement(batch, states)
    model = restated.model(networks.inverse_dynamics)
    policy = Normal(*networks.actor[0](restated.states)[1:])
    pair = (model, policy) if direction == "forward" else (policy, model)
    expected = 0.75 * getattr(kl_divergence(*pair), reduction)(-1).mean()
    gradients = torch.autograd.grad(expected, list(networks.actor.parameters()))
    got = value_and_gradients(loss, batch)
    assert_same(got, [expected.detach(), *gradients], 1e-9)
    metric = loss(batch)[METRIC]
    assert not metric.requires_grad
    torch.testing.assert_close(metric, expected.detach() / 0.75)


@pytest.mark.parametrize("kind", ["delta", "actor", "module"])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
@pytest.mark.parametrize("states", STATES)
def test_deterministic_actors_are_measured_before_the_tanh(
    make_networks, make_batch, kind, low, high, states
) -> None:
    bounds, batch = double(low, high), make_batch(10)
    model_network = make_networks(**bounds).inverse_dynamics
    actor, plain = (deterministic_actor(kind, **bounds) for _ in range(2))
    options = {"direction": "reverse", "states": states, "recovery_weight": 0.75}
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
    assert_same(got, [0.75 * expected.detach(), *gradients], 1e-9)
    # And the pre-tanh action is that of the action which the actor takes.
    action = actor(batch.select("observation"))["action"]
    squashed = 2 * (action - bounds["low"]) / (bounds["high"] - bounds["low"]) - 1
    x = mlp(batch["observation"]) + (kind == "delta") * (low[0] + high[0]) / 2
    torch.testing.assert_close(torch.atanh(squashed), x)


@pytest.mark.parametrize("kind", ["delta", "actor", "raw"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_is_finite_where_the_action_has_saturated(
    make_networks, make_batch, kind, dtype
) -> None:
    actor = deterministic_actor("delta" if kind == "delta" else "actor").to(dtype)
    if kind == "raw":
        actor.module[1] = nn.Identity()  # no tanh at all: actions out of bounds
    last = list(actor.parameters())[-1]
    last.data.fill_(40.0)
    model = make_networks().inverse_dynamics.to(dtype)
    loss = StateRecoveryLoss(actor, model, direction="reverse").to(dtype)
    batch = make_batch(10).apply(lambda t: t.to(dtype) if t.is_floating_point() else t)
    gradients = value_and_gradients(loss, batch)
    assert all(gradient.isfinite().all() for gradient in gradients)
    # A tanh that has saturated lets nothing through; the others pull the action back.
    assert (gradients[-1] > 0).all() == (kind != "actor")


@pytest.mark.parametrize("size", [(10,), (2, 5)])
@pytest.mark.parametrize("weighted", [False, True])
def test_term_is_that_of_osr(make_networks, make_batch, size, weighted) -> None:
    batch, networks = make_batch(*size), make_networks()
    if weighted:
        batch["priority_weight"] = torch.rand(*size, dtype=torch.float64) + 0.1
    ours = make_loss(make_networks())
    osr = OSRLoss(networks.actor, networks.critics, networks.inverse_dynamics).double()
    SoftUpdate(osr, tau=0.1)
    out, expected = ours(batch), osr(batch)
    for key in (KEY, METRIC):
        torch.testing.assert_close(out[key], expected[key], rtol=1e-12, atol=1e-12)
    params = [list(x.actor_network_params.parameters()) for x in (ours, osr)]
    gradients = torch.autograd.grad(out[KEY], params[0])
    assert_same(gradients, torch.autograd.grad(expected[KEY], params[1]))


def other_loss(name: str, networks):
    """A loss of TorchRL's and the actor in it."""
    actor, critics = networks.actor, networks.critics
    if name == "iql":
        value = ValueOperator(MLP(3, 1, num_cells=[8]), ["observation"]).double()
        loss = IQLLoss(actor, critics, value)
    elif name == "sac":
        loss = SACLoss(actor, critics, target_entropy=-2.0)
    else:
        actor = deterministic_actor(name.removeprefix("td3bc-"))
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


@pytest.mark.parametrize("name", ["iql", "sac", "td3bc-delta", "td3bc-actor"])
@pytest.mark.parametrize("order", [1, -1], ids=["after", "before"])
def test_one_summed_backward_gives_the_actor_both_gradients_and_others_one(
    make_networks, make_batch, name, order
) -> None:
    networks, batch = make_networks(), make_batch(10)
    other, actor = other_loss(name, networks)
    direction = "reverse" if name.startswith("td3") else "forward"
    model = networks.inverse_dynamics
    recovery = StateRecoveryLoss(actor, model, direction=direction).double()
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


def test_sharing_survives_a_cast_and_a_step(make_networks, make_batch) -> None:
    networks = make_networks()
    iql, actor = other_loss("iql", networks)
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


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e6])
@pytest.mark.parametrize("states", STATES)
def test_next_state_of_done_rows_changes_no_bit(
    make_networks, make_batch, kind, garbage, states
) -> None:
    loss, batch = make_loss(make_networks(), kind, states=states), make_batch(10)
    wanted = value_and_gradients(loss, batch)
    batch[NEXT][batch["next", "done"].squeeze(-1)] = garbage
    found = value_and_gradients(loss, batch)
    assert all(map(torch.equal, found, wanted))
    batch["next", "done"] = torch.ones_like(batch["next", "done"])
    assert loss(batch)[KEY].item() == 0.0


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_padding_changes_neither_value_nor_gradients(
    make_networks, make_batch, reduction
) -> None:
    loss, batch = make_loss(make_networks(), reduction=reduction), make_batch(2, 5)
    mask = torch.ones(2, 5, 1, dtype=torch.bool)
    mask[:, 3:] = False
    batch["collector", "mask"] = mask
    wanted = value_and_gradients(loss, batch)
    for key in ("observation", NEXT, TWIN):
        batch[key][~mask.squeeze(-1)] = 30.0
    batch["next", "done"][:, 3:] = False
    assert_same(value_and_gradients(loss, batch), wanted)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(10,), (2, 5)])
def test_reductions_agree(make_networks, make_batch, kind, size) -> None:
    batch = make_batch(*size)
    out = {
        reduction: make_loss(make_networks(), kind, reduction=reduction)(batch)
        for reduction in ("none", "sum", "mean")
    }
    done, each = batch["next", "done"].squeeze(-1), out["none"][KEY]
    assert list(out["none"].keys()) == [KEY]
    assert each.shape == size
    assert ((each == 0) == done).all()
    torch.testing.assert_close(out["sum"][KEY], each.sum())
    torch.testing.assert_close(out["mean"][KEY], each.sum() / (~done).sum())
    for reduction in ("sum", "mean"):
        torch.testing.assert_close(0.5 * out[reduction][METRIC], out["mean"][KEY])


def test_rows_weigh_as_much_as_their_priority_weight(make_networks, make_batch) -> None:
    batch, networks = make_batch(10), make_networks()
    rows = make_loss(networks, reduction="none")(batch)[KEY].detach()
    weight = batch["priority_weight"] = torch.rand(10, dtype=torch.float64) + 0.1
    counted = weight * ~batch["next", "done"].squeeze(-1)
    expected = (rows * counted).sum() / counted.sum()
    torch.testing.assert_close(make_loss(networks)(batch)[KEY].detach(), expected)
    ignoring = make_loss(networks, use_prioritized_weights=False)(batch)
    torch.testing.assert_close(ignoring[KEY], 0.5 * ignoring[METRIC])


@pytest.mark.parametrize("states", STATES)
def test_in_keys_are_stable_and_enough(make_networks, make_batch, states) -> None:
    loss, batch = make_loss(make_networks(), states=states), make_batch(10)
    twins = [] if states == "clean" else [TWIN]
    assert loss.in_keys == ["observation", NEXT, ("next", "done"), *twins]
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


def test_nested_and_renamed_keys_give_the_same_numbers(
    make_networks, make_batch
) -> None:
    expected = make_loss(make_networks())(make_batch(10))
    state = ("agent", "observation")
    loss = make_loss(make_networks(observation=state, action=("agent", "action")))
    loss.set_keys(perturbed="noisy", done=("agent", "done"), priority_weight="weight")
    batch = make_batch(10)
    names = {"observation": state, NEXT: unravel_key(("next", state))}
    names |= {TWIN: ("noisy", *state), ("next", "done"): ("next", "agent", "done")}
    for old, new in names.items():
        batch.rename_key_(old, new)
    batch["weight"] = torch.full((10,), 3.0, dtype=torch.float64)
    for key, value in loss(batch).items():
        torch.testing.assert_close(value, expected[key], rtol=1e-12, atol=1e-12)


def test_action_of_a_plain_actor_can_have_another_name(
    make_networks, make_batch
) -> None:
    batch, model = make_batch(10), make_networks().inverse_dynamics
    actor = deterministic_actor("actor", action=("agent", "action"))
    loss = StateRecoveryLoss(actor, model, direction="reverse").double()
    with pytest.raises(KeyError, match=r"writes no 'action': call set_keys\(action="):
        loss(batch)
    loss.set_keys(action=("agent", "action"))
    assert torch.equal(
        loss(batch)[KEY], make_loss(make_networks(), "actor")(batch)[KEY]
    )


@pytest.mark.parametrize("kind", KINDS)
def test_state_dict_and_copies_restore_every_number(
    make_networks, make_batch, kind
) -> None:
    batch, loss = make_batch(10), make_loss(make_networks(), kind)
    for params in (loss.actor_network_params, loss.inverse_dynamics_network_params):
        for tensor in params.values(True, True):
            tensor.data.add_(0.1)
    loss.recovery_weight = 1.25
    wanted = value_and_gradients(loss, batch)
    fresh = make_loss(make_networks(seed=9), kind)
    fresh.load_state_dict(loss.state_dict())
    for twin in (fresh, copy.deepcopy(loss)):
        assert all(map(torch.equal, value_and_gradients(twin, batch), wanted))


def test_weight_can_be_scheduled_in_place_from_zero(make_networks, make_batch) -> None:
    loss, batch = make_loss(make_networks(), recovery_weight=0.0), make_batch(10)
    buffer, kl = loss.recovery_weight, loss(batch)[METRIC]
    for weight in (0.0, 2.0):
        loss.recovery_weight = weight
        out = loss(batch)
        assert loss.recovery_weight is buffer
        assert loss.state_dict()["recovery_weight"].item() == weight
        torch.testing.assert_close(out[KEY].detach(), weight * kl)
        assert torch.equal(out[METRIC], kl)


def test_reset_redraws_the_actor_and_keeps_the_frozen_model(make_networks) -> None:
    loss = make_loss(make_networks())
    groups = (loss.actor_network_params, loss.inverse_dynamics_network_params)
    for params in groups:
        params.apply_(lambda tensor: tensor.data.add_(1000.0))
    loss.reset_parameters_recursive()
    reset, kept = (
        [t.abs().min() for t in group.values(True, True)] for group in groups
    )
    assert max(reset) < 100 < min(kept)


# Raised inside tensordict 0.14.3 and TorchRL 0.14.1 while torch 2.13 traces them.
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.filterwarnings("ignore:Using lock_.. inside a compiled:UserWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_compiled_loss_equals_eager_without_graph_breaks(
    make_networks, make_batch, kind
) -> None:
    networks, batch = make_networks(), make_batch(10)
    if kind == "gaussian":
        loss = make_loss(networks)
    else:
        # With safe=True TorchRL 0.14.1 refuses to compile a TanhDelta, on any torch.
        actor = deterministic_actor(
            kind, **({"safe": False} if kind == "delta" else {})
        )
        model = networks.inverse_dynamics
        loss = StateRecoveryLoss(actor, model, direction="reverse").double()
    eager = value_and_gradients(loss, batch)
    torch.compiler.reset()
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    value = compiled(batch)[KEY]
    gradients = torch.autograd.grad(value, list(loss.parameters()))
    assert_same([value.detach(), *gradients], eager)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("recovery_weight", -0.5),
        ("recovery_weight", math.nan),
        ("direction", "backward"),
        ("action_reduction", "max"),
        ("states", "noisy"),
        ("reduction", "median"),
    ],
)
def test_options_out_of_range_are_named(make_networks, option, value) -> None:
    with pytest.raises(ValueError, match=f"{option} must be .*{value}"):
        make_loss(make_networks(), **{option: value})


@pytest.mark.parametrize("kind", ["delta", "actor", "module"])
def test_deterministic_actor_is_told_to_take_the_reverse_direction(
    make_networks, kind
) -> None:
    model = make_networks().inverse_dynamics
    with pytest.raises(ValueError, match="deterministic.*Pass direction='reverse'"):
        StateRecoveryLoss(deterministic_actor(kind), model)


@pytest.mark.parametrize("wrong", ["actor", "inverse_dynamics"])
def test_other_distribution_families_are_refused(make_networks, wrong) -> None:
    networks = make_networks()
    other = make_networks(distribution_class=TruncatedNormal)
    setattr(networks, wrong, getattr(other, wrong))
    with pytest.raises(TypeError, match=f"{wrong}_network must end in a TanhNormal"):
        make_loss(networks)


@pytest.mark.parametrize("kind", ["gaussian", "delta"])
@pytest.mark.parametrize(("low", "high"), [(-2.0, 1.0), (-1.0, torch.tensor([1.0, 2]))])
def test_bounds_that_differ_are_refused(make_networks, kind, low, high) -> None:
    networks = make_networks()
    networks.inverse_dynamics = make_networks(low=low, high=high).inverse_dynamics
    with pytest.raises(ValueError, match=r"share their action bounds.*2\.0"):
        make_loss(networks, kind)


@pytest.mark.parametrize("kind", KINDS)
def test_missing_twin_is_named_with_the_cure(make_networks, make_batch, kind) -> None:
    batch = make_batch(10, twin=False)
    with pytest.raises(KeyError, match=r"perturbed.*observation.*StatePerturbation"):
        make_loss(make_networks(), kind)(batch)
    assert make_loss(make_networks(), kind, states="clean")(batch)[KEY].isfinite()
