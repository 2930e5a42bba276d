"""StateRecoveryLoss by itself, beside TorchRL's own losses and combined with a loss."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import Networks, density, make_batch, make_loss, update_targets
from objectives.plain import BOX, UNIT
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import kl_divergence
from torchrl.modules import Delta, ProbabilisticActor
from torchrl.objectives import IQLLoss, SACLoss, TD3BCLoss

from torchrl_osr import StateRecoveryLoss
from torchrl_osr.objectives import WithRecovery

KEY = "loss_recovery"
KINDS = {"iql": "actor", "sac": "actor", "td3-bc": "delta"}
STATES = {"clean": [0], "perturbed": [1], "both": [0, 1]}


def before_tanh(networks: Networks, kind: str, state: Tensor) -> Tensor:
    """Return the action before the tanh, of an actor by itself."""
    actor = getattr(networks, kind)
    if kind == "delta":  # TorchRL moves a TanhDelta's parameter by the center
        center = (networks.bounds["low"] + networks.bounds["high"]) / 2
        return actor[0].module(state) + center
    return (actor[0] if kind == "gaussian" else actor).module[0](state)


def restated(networks, kind, batch, states, direction: str, reduction: str) -> Tensor:
    """Return the term by torch.distributions, over rows with a next state."""
    kept = ~batch["next", "done"].squeeze(-1)
    both = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    s, after = both[STATES[states]][:, kept], batch["next", "observation"][kept]
    with torch.no_grad():
        model = density(networks.model, s, after.expand_as(s))
    if kind == "actor":
        pair = [model, density(networks.actor, s)]
        each = kl_divergence(*(pair[::-1] if direction == "reverse" else pair))
    else:
        each = (before_tanh(networks, kind, s) - model.loc) ** 2 / (2 * model.scale**2)
    return getattr(each, reduction)(-1).mean()


def check_term(check, label, loss, batch, expected: Tensor, actor) -> None:
    """Compare value, gradients and metric with an unweighted term."""
    (metric,) = set(loss.out_keys) - {KEY}
    out = loss(batch)
    assert not out[metric].requires_grad
    (0.75 * expected).backward()
    out[KEY].backward()
    held = loss.actor_network_params.flatten_keys(".")
    pairs = [(held[name].grad, each.grad) for name, each in actor.named_parameters()]
    # The scale of a Gaussian is not trained by the divergence.
    ours, theirs = zip(*(pair for pair in pairs if pair[1] is not None), strict=True)
    found, expected = [out[KEY].detach(), out[metric], *ours], expected.detach()
    check(label, found, [0.75 * expected, expected, *theirs], tolerance=1e-10)


WAYS = [
    ("actor", "forward", "sum", "both"),
    ("actor", "forward", "mean", "clean"),
    ("actor", "reverse", "mean", "perturbed"),
    ("delta", "reverse", "mean", "both"),
    ("module", "forward", "sum", "perturbed"),
    ("gaussian", "forward", "sum", "clean"),
]


@pytest.mark.parametrize(("kind", "direction", "reduction", "states"), WAYS)
def test_term_equals_the_divergence(check, kind, direction, reduction, states) -> None:
    # A Gaussian without a tanh has no bounds of its own.
    bounds = UNIT if kind == "gaussian" else BOX
    networks, plain = Networks(**bounds), Networks(**bounds)
    options = {"recovery_direction": direction, "action_reduction": reduction}
    options |= {"recovery_states": states, "recovery_weight": 0.75}
    loss = StateRecoveryLoss(getattr(networks, kind), networks.model, **options)
    assert (("perturbed", "observation") in loss.in_keys) == (states != "clean")
    batch, actor = make_batch("recovery", 10), getattr(plain, kind)
    expected = restated(plain, kind, batch, states, direction, reduction)
    batch = batch.select(*loss.in_keys)
    check_term(check, "State recovery alone", loss.double(), batch, expected, actor)


def test_a_delta_actor_is_read_as_the_module_in_it() -> None:
    networks, batch = Networks(), make_batch("recovery", 10)
    inner = TensorDictModule(networks.module.module, ["observation"], ["param"])
    delta = ProbabilisticActor(inner, ["param"], distribution_class=Delta)
    losses = (StateRecoveryLoss(x, networks.model) for x in (delta, networks.module))
    assert torch.equal(*(loss(batch)[KEY] for loss in losses))


@pytest.mark.parametrize("states", STATES)
@pytest.mark.parametrize("kind", ["actor", "delta", "module", "gaussian"])
def test_noisy_cloning_equals_the_restatement(check, kind, states) -> None:
    networks, plain, batch = Networks(), Networks(), make_batch("noisy-cloning", 10)
    options = {"recovery_states": states, "recovery_weight": 0.75}
    options |= {"recovery_target": "data"}
    loss = StateRecoveryLoss(getattr(networks, kind), **options).double()
    assert ("next", "observation") not in loss.in_keys
    actor, kept = getattr(plain, kind), ~batch["next", "done"].squeeze(-1)
    both = torch.stack([batch["observation"], batch["perturbed", "observation"]])
    s = both[STATES[states]][:, kept]
    action = batch["action"][kept].expand(len(s), -1, -1)
    if kind == "actor":
        each = (1 - action**2).log() - density(actor, s).log_prob(action.atanh())
    elif kind == "gaussian":
        each = -density(actor, s).log_prob(action)
    else:
        each = (torch.tanh(before_tanh(plain, kind, s)) - action) ** 2
    expected = each.sum(-1).mean()
    check_term(check, "Noisy cloning alone", loss, batch, expected, actor)


@pytest.mark.parametrize("kind", ["delta", "module", "raw"])
def test_gradient_is_finite_where_the_action_has_saturated(kind) -> None:
    networks = Networks()
    actor = networks.delta if kind == "delta" else networks.module
    if kind == "raw":
        actor.module[1] = nn.Identity()  # no tanh at all: actions out of bounds
    last = [each for each in actor.modules() if isinstance(each, nn.Linear)][-1]
    last.bias.data.fill_(50.0)
    loss = StateRecoveryLoss(actor, networks.model).double()
    loss(make_batch("recovery", 10))[KEY].backward()
    assert last.bias.grad.isfinite().all()
    # A tanh that has saturated lets nothing through; the others pull the action back.
    assert (last.bias.grad > 0).all() == (kind != "module")


def other_loss(kind: str, networks: Networks):
    """Return a loss of TorchRL for an actor."""
    actor, critics = getattr(networks, KINDS[kind]), networks.critics
    if kind == "iql":
        loss = IQLLoss(actor, critics, networks.value)
    elif kind == "sac":
        loss = SACLoss(actor, critics, target_entropy=-2.0)
    else:
        loss = TD3BCLoss(actor, critics, bounds=(-1.0, 1.0))
    loss.make_value_estimator(gamma=0.9)
    return update_targets(loss.double())


def backward(losses, parameters) -> tuple[Tensor, ...]:
    """Return the gradients of one backward over the sum of all losses."""
    total = sum(value for key, value in losses.items() if key.startswith("loss_"))
    return torch.autograd.grad(total, parameters, materialize_grads=True)


@pytest.mark.parametrize("kind", KINDS)
def test_beside_torchrls_losses_the_actor_gets_both_gradients(kind) -> None:
    networks, batch = Networks(), make_batch("osr", 10)
    other, actor = other_loss(kind, networks), getattr(networks, KINDS[kind])
    recovery = StateRecoveryLoss(actor, networks.model).double()
    assert set(recovery.parameters()) == set(actor.parameters())
    names, parameters = zip(*other.named_parameters(), strict=True)
    terms = []
    for loss in (other, recovery, WithRecovery(other, recovery)):
        torch.manual_seed(2)
        terms.append(backward(loss(batch.clone()), parameters))
    for key, base, extra, both in zip(names, *terms, strict=True):
        torch.testing.assert_close(both, base + extra, rtol=1e-12, atol=1e-12)
        assert extra.any() == key.startswith("actor_network_params"), key


def test_a_pair_has_the_estimator_and_the_parameters_of_its_parts() -> None:
    pair, batch = make_loss("official"), make_batch("official", 10)
    pair.make_value_estimator(gamma=0.5)
    assert pair.value_estimator is pair.loss.value_estimator
    assert pair.value_estimator.gamma == 0.5
    given = {
        "_".join([key] if isinstance(key, str) else key): batch[key]
        for key in pair.in_keys
    }
    assert pair(**given) is not None
    matrices = [each for each in pair.parameters() if each.ndim > 1]
    before = [each.clone() for each in matrices]
    pair.reset_parameters_recursive()
    assert not any(map(torch.equal, before, matrices))


def test_a_model_and_one_actor_are_asked_for() -> None:
    first, second = (make_loss("official") for _ in range(2))
    with pytest.raises(ValueError, match="of another actor than the loss's"):
        WithRecovery(first.loss, second.recovery)
    with pytest.raises(ValueError, match="needs an inverse_dynamics_network"):
        StateRecoveryLoss(Networks().actor)
