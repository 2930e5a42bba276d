"""Attacked policies: the box, what each attack finds, and trained losses."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import ObservationNorm
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss

from torchrl_osr.lab.envs import attacked_policy, critics_of
from torchrl_osr.lab.evaluation import deterministic_policy
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor

KINDS = ["random", "action_diff", "min_Q"]
each_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module")
def trained():
    """A loss, its networks and a standardisation."""
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(11, 3, num_cells=[16])
    critic, _ = critic_ensemble(11, 3, num_cells=[16])
    loss = SACLoss(actor, critic, num_qvalue_nets=2, target_entropy=-3.0)
    norm = ObservationNorm(
        torch.randn(11), torch.rand(11) + 0.5, ["observation"], standard_normal=True
    )
    return SimpleNamespace(
        actor=actor, policy=actor.get_dist, qvalue=critics_of(loss), norm=norm
    )


def states_of(observation):
    return TensorDict({"observation": observation}, observation.shape[:-1])


def shown(trained, observation, **arguments):
    """What the attacked policy is shown in the place of standardised observations."""
    seen = []

    def policy(states):
        seen.append(states["observation"])
        return trained.policy(states)

    attacked_policy(policy, trained.qvalue, **arguments)(observation)
    return seen[-1]


@given(
    st.sampled_from(KINDS), st.floats(0, 3), st.integers(1, 5), st.integers(0, 2**32)
)
@settings(deadline=None, max_examples=40)
def test_observations_stay_in_the_box(trained, kind, epsilon, episodes, seed):
    clean = torch.randn(episodes, 11, generator=torch.Generator().manual_seed(seed))
    arguments = {"epsilon": epsilon, "num_samples": 3, "seed": seed}
    observation = shown(trained, clean, kind=kind, **arguments)
    # The sum of state and perturbation is rounded.
    unit = torch.finfo(clean.dtype).eps * (clean.abs() + epsilon)
    assert ((observation - clean).abs() <= epsilon + 2 * unit).all()
    assert observation.shape == clean.shape
    if epsilon > 1e-3:
        assert not torch.equal(observation, clean) or kind == "min_Q"


@each_kind
def test_epsilon_0_is_the_bare_policy(trained, kind):
    observation = torch.randn(8, 11)

    policy = attacked_policy(
        trained.policy, trained.qvalue, trained.norm, kind=kind, epsilon=0.0
    )
    bare = deterministic_policy(trained.actor, trained.norm)
    assert torch.equal(policy(observation), bare(observation))


def test_critics_of_a_loss_are_its_trained_ones():
    head = MLP(14, 1, num_cells=[16])
    critic = ValueOperator(head, ["observation", "a"], ["q"])
    actor = tanh_gaussian_actor(11, 3, num_cells=[16])
    loss = SACLoss(actor, critic, num_qvalue_nets=3)
    loss.set_keys(action="a", state_action_value="q")
    values = critics_of(loss)
    states, action = states_of(torch.randn(4, 8, 11)), torch.rand(4, 8, 3)
    with torch.no_grad():  # as an optimizer changes them
        for parameter in loss.qvalue_network_params.parameters():
            parameter.mul_(1.5)
    after = values(states, action)
    assert after.shape == (3, 4, 8)
    assert not after.requires_grad
    for index in range(3):
        head = MLP(14, 1, num_cells=[16])
        for name, parameter in head.named_parameters():
            key = ("module", *name.split("."))
            parameter.data = loss.qvalue_network_params.get(key)[index].detach()
        expected = head(torch.cat([states["observation"], action], -1)).squeeze(-1)
        torch.testing.assert_close(after[index], expected)
    assert list(states.keys()) == ["observation"]


@each_kind
def test_seeds_decide_and_the_global_generator_is_left_alone(trained, kind):
    attack = partial(attacked_policy, trained.policy, trained.qvalue, kind=kind)
    observation, state = torch.randn(8, 11), torch.get_rng_state()
    policy, again, other = (attack(epsilon=0.5, seed=seed) for seed in (1, 1, 2))
    first = policy(observation)
    assert torch.equal(first, again(observation))
    assert not torch.equal(first, other(observation))
    assert not torch.equal(first, policy(observation)), "draws go on from call to call"
    assert torch.equal(state, torch.get_rng_state())
