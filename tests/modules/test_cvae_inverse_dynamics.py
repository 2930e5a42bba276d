"""The conditional VAE: its interface, its latent, and a scale free of its mean."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torchrl.modules import TanhNormal

from torchrl_osr import InverseDynamicsLoss, StateRecoveryLoss
from torchrl_osr.functional import gaussian_kl, state_recovery
from torchrl_osr.lab.evaluation import inverse_dynamics_report
from torchrl_osr.modules import (
    cvae_inverse_dynamics,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

LATENT_KEYS = ["latent_loc", "latent_scale"]
OUT_KEYS = ["loc", "scale", "action", "action_log_prob"]
DRAWS, RANDOM = InteractionType, InteractionType.RANDOM
STILL = [DRAWS.DETERMINISTIC, DRAWS.MODE, DRAWS.MEDIAN, DRAWS.MEAN, None]


def make_model(**kwargs):
    return cvae_inverse_dynamics(3, 2, **({"latent_dim": 4, "num_cells": [8]} | kwargs))


def make_states(*size: int, scale: float = 1.0) -> TensorDict:
    observation, next_observation = scale * torch.randn(2, *size, 3)
    next_states = {"observation": next_observation}
    return TensorDict({"observation": observation, "next": next_states}, size)


def correlation(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Pearson's correlation of each column, ``[A]``."""
    x, y = x - x.mean(0), y - y.mean(0)
    return (x * y).sum(0) / (x.norm(dim=0) * y.norm(dim=0))


@pytest.mark.parametrize("size", [(7,), (2, 3), (2, 5, 3), ()])
def test_outputs_have_one_entry_a_dimension(size) -> None:
    out = make_model()(make_states(*size))
    for key in ("loc", "scale", "action"):
        assert out[key].shape == (*size, 2)
    for key in LATENT_KEYS:
        assert out[key].shape == (*size, 4)
    assert out["action_log_prob"].shape == size


def test_it_stands_in_for_the_tanh_gaussian_model() -> None:
    bounds = {"low": torch.tensor([-1.0, -2.0]), "high": torch.tensor([2.0, 1.0])}
    model = make_model(**bounds)
    plain = tanh_gaussian_inverse_dynamics(3, 2, num_cells=[8], **bounds)
    assert model.in_keys == plain.in_keys
    assert set(OUT_KEYS) <= set(plain.out_keys)
    assert set(model.out_keys) == {*OUT_KEYS, *LATENT_KEYS}
    ours, theirs = (net.get_dist(make_states(7)) for net in (model, plain))
    assert type(ours) is type(theirs) is TanhNormal
    assert torch.equal(ours.low, theirs.low)
    assert torch.equal(ours.high, theirs.high)
    action = model(make_states(500, scale=300))["action"]
    assert (action >= bounds["low"]).all()
    assert (action <= bounds["high"]).all()


def test_layers_are_the_authors_by_default() -> None:
    # Encoder 3 x 256 to 2 x 32 outputs, decoder 2 x 256; two states of 11, z of 32.
    model = cvae_inverse_dynamics(11, 3)
    layers = [m for m in model.modules() if isinstance(m, torch.nn.Linear)]
    sizes = [(layer.in_features, layer.out_features) for layer in layers]
    assert sizes[:4] == [(22, 256), (256, 256), (256, 256), (256, 64)]
    assert sizes[4:] == [(54, 256), (256, 256), (256, 6)]
    tanh = make_model(num_cells=[6, 5], activation_class=torch.nn.Tanh)
    assert sum(isinstance(m, torch.nn.Tanh) for m in tanh.modules()) == 3 + 2


def test_extreme_states_give_finite_scales_and_divergence() -> None:
    out = make_model()(make_states(500, scale=1e4))
    assert out["scale"].min().item() == pytest.approx(1e-2)
    latent_scale = out["latent_scale"].log()
    assert latent_scale.min().item() == pytest.approx(-4)
    assert latent_scale.max().item() == pytest.approx(15)
    loc, scale = (out[key] for key in LATENT_KEYS)
    prior = torch.zeros_like(loc), torch.ones_like(scale)
    assert gaussian_kl(loc, scale, *prior).isfinite().all()


def test_a_model_without_a_latent_is_refused() -> None:
    with pytest.raises(ValueError, match="latent_dim must be at least 1, got 0"):
        make_model(latent_dim=0)


@pytest.mark.parametrize("kind", STILL)
def test_the_latent_is_its_mean_unless_draws_are_asked_for(kind) -> None:
    model, batch = make_model(), make_states(7)
    core = model.module[0].module
    states = batch["observation"], batch["next", "observation"]
    state = torch.get_rng_state()
    with set_interaction_type(kind):
        params = model.get_dist_params(batch)
    assert torch.equal(torch.get_rng_state(), state)
    decoded = core.decoder(*states, params["latent_loc"])[..., :2]
    torch.testing.assert_close(params["loc"], decoded)


def test_the_policys_losses_and_the_report_never_draw() -> None:
    model, data = make_model(), make_states(7)
    data["action"] = torch.rand(7, 2)
    data["next", "done"] = torch.zeros(7, 1, dtype=torch.bool)
    actor = tanh_gaussian_actor(3, 2, num_cells=[8])
    loss = StateRecoveryLoss(actor, model, recovery_states="clean")
    recovery, report = loss(data)["recovery_kl"], inverse_dynamics_report(model, data)
    pi, still = actor.get_dist(data), model.get_dist(data)
    wanted = state_recovery(pi.loc, pi.scale, still.loc, still.scale).mean()
    torch.testing.assert_close(recovery, wanted.detach())
    with set_interaction_type(RANDOM):
        assert torch.equal(loss(data)["recovery_kl"], recovery)
        assert inverse_dynamics_report(model, data) == report
        assert not torch.equal(model.get_dist(data).loc, still.loc)


@pytest.mark.filterwarnings("ignore:.*autograd.function.Function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
def test_compiled_model_equals_eager_for_each_interaction_type() -> None:
    model, batch = make_model(), make_states(2, 7)
    torch.compiler.reset()
    compiled = torch.compile(model, backend="eager", fullgraph=True)

    def call(network, kind: InteractionType) -> TensorDict:
        torch.manual_seed(3)
        with set_interaction_type(kind):
            return network(batch.clone())

    # Random twice: the graph of the other type must not be taken for it.
    for kind in (RANDOM, DRAWS.DETERMINISTIC, RANDOM):
        found, wanted = call(compiled, kind), call(model, kind)
        for key in model.out_keys:
            torch.testing.assert_close(found[key], wanted[key])


def test_double_stays_double() -> None:
    model = make_model(low=torch.tensor(-1.0).double()).double()
    with set_interaction_type(RANDOM):
        out = model(make_states(7).to(torch.float64))
    assert all(out[key].dtype is torch.float64 for key in model.out_keys)


def heteroscedastic_world(size: int) -> tuple[TensorDict, torch.Tensor, torch.Tensor]:
    """Transitions, and mean and log standard deviation of their pre-tanh action.

    The mean depends on s', the spread on s alone: they are independent.
    """
    batch = make_states(size)
    loc = 0.5 * batch["next", "observation"][:, :2]
    log_scale = 0.5 * batch["observation"][:, :2] - 1.5
    batch["action"] = torch.tanh(loc + log_scale.exp() * torch.randn_like(loc))
    batch["next", "done"] = torch.zeros(size, 1, dtype=torch.bool)
    return batch, loc, log_scale


def fit(model, batch: TensorDict) -> TensorDict:
    """Train by likelihood; return what the model then writes, z at its mean."""
    loss = InverseDynamicsLoss(model, states="clean")
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for _ in range(300):
        optimizer.zero_grad()
        loss(batch)["loss_inverse_dynamics"].backward()
        optimizer.step()
    with torch.no_grad():
        return model.get_dist_params(batch.clone())


def test_the_scale_learns_what_the_mean_does_not_know() -> None:
    batch, loc, log_scale = heteroscedastic_world(2048)
    out = fit(make_model(num_cells=[32]), batch)
    assert (correlation(out["loc"], loc) > 0.95).all()
    assert (correlation(out["scale"].log(), log_scale) > 0.9).all()
    assert (correlation(out["scale"].log(), out["loc"]).abs() < 0.3).all()
    # The documented limit: the latent has collapsed to its prior.
    prior = torch.tensor(0.0), torch.tensor(1.0)
    kl = gaussian_kl(out["latent_loc"], out["latent_scale"], *prior)
    assert kl.mean().item() < 0.05


@pytest.mark.parametrize("seed", range(5))
def test_scale_and_mean_are_not_tied_before_training_either(seed) -> None:
    torch.manual_seed(seed)
    model, batch = make_model(num_cells=[32, 32]), make_states(1000)
    out = model(batch)
    assert (correlation(out["scale"].log(), out["loc"]).abs() < 0.99).all()
