"""Where the policy seeks values, whatever the recovery term does."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch.distributions import Categorical, Normal

from torchrl_osr import OSRLoss

STATES = {
    "both": [("observation",), ("perturbed", "observation")],
    "clean": [("observation",)],
    "perturbed": [("perturbed", "observation")],
}
ALPHA = 0.5


def plain_objective(networks, states: torch.Tensor) -> torch.Tensor:
    """Mean of alpha log pi(a | s) - min Q(s, a) with the draws of the loss."""
    _, loc, scale = networks.actor[0](states)
    latent = loc + scale * torch.randn_like(loc)
    action = torch.tanh(latent)
    log_prob = Normal(loc, scale).log_prob(latent) - torch.log(1 - action**2)
    inputs = torch.cat([states, action], -1)
    values = [critic.module(inputs).squeeze(-1) for critic in networks.critics]
    return (ALPHA * log_prob.sum(-1) - torch.minimum(*values)).mean()


def plain_discrete_objective(networks, states: torch.Tensor) -> torch.Tensor:
    """The same in expectation over all actions."""
    policy = Categorical(logits=networks.actor[0].module(states))
    values = torch.minimum(*[critic.module(states) for critic in networks.critics])
    return (-ALPHA * policy.entropy() - (policy.probs * values).sum(-1)).mean()


@pytest.mark.parametrize("actor_states", STATES)
@pytest.mark.parametrize("recovery_weight", [0.0, 0.75])
@pytest.mark.losses("osr", "discrete")
def test_value_term_is_the_plain_one_on_the_states_that_were_asked_for(
    family, family_batch, terms, check, name, actor_states, recovery_weight
) -> None:
    batch, networks = family_batch(name, 10), family.networks(name)
    options = {"actor_states": actor_states, "recovery_weight": recovery_weight}
    loss = family(name, family.networks(name), **options)
    loss.log_alpha.data.fill_(math.log(ALPHA))
    value = terms(name, loss, batch)["loss_actor"]
    states = torch.stack([batch[key] for key in STATES[actor_states]])
    torch.manual_seed(2)
    plain = plain_discrete_objective if family[name].discrete else plain_objective
    expected = plain(networks, states)
    found, wanted = (
        [each.detach(), *torch.autograd.grad(each, list(parameters))]
        for each, parameters in [
            (value, loss.actor_network_params.parameters()),
            (expected, networks.actor.parameters()),
        ]
    )
    label = "Discrete OSR" if family[name].discrete else "OSR"
    check(label, found, wanted, tolerance=1e-10)


@pytest.mark.losses("osr", "discrete")
def test_recovery_term_does_not_depend_on_the_actor_states(
    family, family_batch, terms, name
) -> None:
    batch, found = family_batch(name, 10), {}
    for actor, recovery in itertools.product(STATES, STATES):
        options = {"actor_states": actor, "recovery_states": recovery}
        value = terms(name, family(name, **options), batch)["recovery"]
        expected = found.setdefault(recovery, value)
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found["both"], (found["clean"] + found["perturbed"]) / 2)
    assert found["clean"] != found["perturbed"]


@pytest.mark.losses("osr", "discrete")
@pytest.mark.parametrize("recovery_weight", [0.0, 0.5])
@pytest.mark.parametrize("actor_states", STATES)
@pytest.mark.parametrize("recovery_states", STATES)
def test_perturbed_states_are_read_if_either_term_asks_for_them(
    family, family_batch, name, recovery_weight, actor_states, recovery_states
) -> None:
    loss = family(
        name,
        recovery_weight=recovery_weight,
        actor_states=actor_states,
        recovery_states=recovery_states,
    )
    clean = actor_states == "clean" and (
        recovery_states == "clean" or not recovery_weight
    )
    assert (("perturbed", "observation") in loss.in_keys) == (not clean)
    batch = family_batch(name, 10, perturbed=False)
    if clean:
        assert loss(batch)["loss_actor"].isfinite()
    else:
        with pytest.raises(KeyError, match="StatePerturbation.*actor_states=.*clean"):
            loss(batch)


def test_a_mistyped_option_is_refused(make_networks) -> None:
    networks = make_networks()
    with pytest.raises(TypeError, match="unexpected keyword argument 'actor_state'"):
        OSRLoss(
            networks.actor, networks.critics, recovery_weight=0.0, actor_state="clean"
        )
