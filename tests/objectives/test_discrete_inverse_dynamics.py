"""DiscreteInverseDynamicsLoss: the cross-entropy, on which rows, and that it learns."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical

from torchrl_osr import DiscreteInverseDynamicsLoss, InverseDynamicsLoss
from torchrl_osr.modules import categorical_inverse_dynamics

KEY = "loss_inverse_dynamics"


@pytest.mark.parametrize("one_hot", [True, False])
@pytest.mark.parametrize("states", ["both", "clean"])
def test_loss_and_gradient_equal_the_restatement(
    make_discrete_networks, make_discrete_batch, one_hot, states
) -> None:
    kwargs = {} if one_hot else {"distribution_class": Categorical}
    network = make_discrete_networks(**kwargs).inverse_dynamics
    mlp, batch = network[0].module, make_discrete_batch(10)
    index, done = batch["action"].argmax(-1), batch["next", "done"].squeeze(-1)
    inputs = [batch["observation"], batch["perturbed", "observation"]]
    expected = 0.0
    for state in inputs[: 2 if states == "both" else 1]:
        pair = torch.cat([state, batch["next", "observation"]], -1)[~done]
        log_prob = Categorical(logits=mlp(pair)).log_prob(index[~done])
        expected = expected - log_prob.mean() / (2 if states == "both" else 1)
    wanted = torch.autograd.grad(expected, list(mlp.parameters()))
    if not one_hot:
        batch["action"] = index
    loss = DiscreteInverseDynamicsLoss(network, states=states)
    value = loss(batch)[KEY]
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-9)
    value.backward()
    parameters = loss.inverse_dynamics_network_params.values(True, True)
    for parameter, gradient in zip(parameters, wanted, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-9, atol=1e-9)


def test_keys_are_those_of_the_continuous_loss(
    make_networks, make_discrete_networks
) -> None:
    continuous = InverseDynamicsLoss(make_networks().inverse_dynamics)
    discrete = DiscreteInverseDynamicsLoss(make_discrete_networks().inverse_dynamics)
    assert discrete.in_keys == continuous.in_keys
    assert discrete.out_keys == continuous.out_keys == [KEY]
    assert vars(discrete.tensor_keys) == vars(continuous.tensor_keys)


@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_next_state_of_done_rows_changes_no_bit(
    make_discrete_networks, make_discrete_batch, garbage
) -> None:
    loss = DiscreteInverseDynamicsLoss(make_discrete_networks().inverse_dynamics)
    batch = make_discrete_batch(10)
    spoiled = batch.clone()
    spoiled["next", "observation"][batch["next", "done"].squeeze(-1)] = garbage
    parameters = list(loss.parameters())
    clean, other = (
        [value, *torch.autograd.grad(value, parameters)]
        for value in (loss(batch)[KEY], loss(spoiled)[KEY])
    )
    assert all(map(torch.equal, clean, other))
    batch["next", "done"][:] = True
    assert loss(batch)[KEY].item() == 0.0


@pytest.mark.parametrize("size", [(10,), (2, 5)])
def test_reductions_agree(make_discrete_networks, make_discrete_batch, size) -> None:
    batch = make_discrete_batch(*size)
    done = batch["next", "done"].squeeze(-1)
    mean, total, each = (
        DiscreteInverseDynamicsLoss(
            make_discrete_networks().inverse_dynamics, reduction=reduction
        )(batch)[KEY]
        for reduction in ("mean", "sum", "none")
    )
    assert each.shape == size
    assert ((each == 0) == done).all()
    torch.testing.assert_close(total, each.sum())
    torch.testing.assert_close(mean, each.sum() / (~done).sum())


def test_renamed_keys_give_the_same_number(
    make_discrete_networks, make_discrete_batch
) -> None:
    batch = make_discrete_batch(10)
    model = make_discrete_networks().inverse_dynamics
    wanted = DiscreteInverseDynamicsLoss(model)(batch)[KEY]
    loss = DiscreteInverseDynamicsLoss(make_discrete_networks().inverse_dynamics)
    loss.set_keys(action=("agent", "choice"), perturbed="noisy", done="over")
    batch.rename_key_("action", ("agent", "choice"))
    batch.rename_key_("perturbed", "noisy")
    batch["next"].rename_key_("done", "over")
    assert torch.equal(loss(batch)[KEY], wanted)


def test_it_finds_the_likelihood_of_a_noisy_table() -> None:
    # s' tells which of two actions was taken in three cases of four.
    action = torch.tensor([0, 0, 0, 1, 1, 1, 1, 0]).repeat(8)
    seen = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1]).repeat(8)
    batch = TensorDict(
        {
            "observation": torch.zeros(64, 2),
            "action": torch.nn.functional.one_hot(action, 2),
            "next": {
                "observation": torch.eye(2)[seen],
                "done": torch.zeros(64, 1, dtype=torch.bool),
            },
        },
        [64],
    )
    model = categorical_inverse_dynamics(2, 2, num_cells=[8])
    loss = DiscreteInverseDynamicsLoss(model, states="clean")
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.05)
    for _ in range(150):
        optimizer.zero_grad()
        loss(batch)[KEY].backward()
        optimizer.step()
    # The entropy of (3/4, 1/4).
    assert loss(batch)[KEY].item() == pytest.approx(0.5623351, abs=1e-3)
    probs = model.get_dist(batch).probs
    wanted = torch.where(seen.bool(), 0.75, 0.25)
    torch.testing.assert_close(probs[:, 1], wanted, rtol=0, atol=0.02)
