"""Inverse dynamics models: what they read, and the latent of the conditional VAE."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type

from torchrl_osr.functional import gaussian_kl
from torchrl_osr.modules import cvae_inverse_dynamics

LATENT_KEYS = ["latent_loc", "latent_scale"]
RANDOM = InteractionType.RANDOM


def make_model(**options):
    return cvae_inverse_dynamics(3, 2, **{"latent_dim": 4, "num_cells": [8]} | options)


def states(*size: int, scale: float = 1.0) -> TensorDict:
    observation, next_observation = scale * torch.randn(2, *size, 3)
    next_states = {"observation": next_observation}
    return TensorDict({"observation": observation, "next": next_states}, size)


def test_layers_are_the_authors_by_default() -> None:
    # Encoder 3 x 256 to 2 x 32 outputs, decoder 2 x 256; two states of 11, z of 32.
    model = cvae_inverse_dynamics(11, 3)
    layers = [m for m in model.modules() if isinstance(m, torch.nn.Linear)]
    sizes = [(layer.in_features, layer.out_features) for layer in layers]
    assert sizes[:4] == [(22, 256), (256, 256), (256, 256), (256, 64)]
    assert sizes[4:] == [(54, 256), (256, 256), (256, 6)]


def test_extreme_states_give_finite_scales_and_divergence() -> None:
    out = make_model()(states(500, scale=1e4))
    assert out["scale"].min().item() == pytest.approx(1e-2)
    latent_scale = out["latent_scale"].log()
    assert latent_scale.min().item() == pytest.approx(-4)
    assert latent_scale.max().item() == pytest.approx(15)
    loc, scale = (out[key] for key in LATENT_KEYS)
    prior = torch.zeros_like(loc), torch.ones_like(scale)
    assert gaussian_kl(loc, scale, *prior).isfinite().all()


@pytest.mark.parametrize("kind", [InteractionType.DETERMINISTIC, None])
def test_the_latent_is_its_mean_unless_draws_are_asked_for(kind) -> None:
    model, batch = make_model(), states(7)
    core = model.module[0].module
    pair = batch["observation"], batch["next", "observation"]
    state = torch.get_rng_state()
    with set_interaction_type(kind):
        params = model.get_dist_params(batch)
    assert torch.equal(torch.get_rng_state(), state)
    decoded = core.decoder(*pair, params["latent_loc"])[..., :2]
    torch.testing.assert_close(params["loc"], decoded)
    with set_interaction_type(RANDOM):
        assert not torch.equal(model.get_dist_params(batch)["loc"], decoded)


@pytest.mark.filterwarnings("ignore:.*autograd.function.Function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
def test_compiled_model_equals_eager_for_each_interaction_type() -> None:
    model, batch = make_model(), states(2, 7)
    torch.compiler.reset()
    compiled = torch.compile(model, backend="eager", fullgraph=True)

    def call(network, kind: InteractionType) -> TensorDict:
        torch.manual_seed(3)
        with set_interaction_type(kind):
            return network(batch.clone())

    # Random twice: the graph of the other type must not be taken for it.
    for kind in (RANDOM, InteractionType.DETERMINISTIC, RANDOM):
        found, wanted = call(compiled, kind), call(model, kind)
        for key in model.out_keys:
            torch.testing.assert_close(found[key], wanted[key])
