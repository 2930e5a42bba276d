"""DiscreteInverseDynamicsLoss: the cross-entropy, on which rows, and that it learns."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical

from torchrl_osr import DiscreteInverseDynamicsLoss
from torchrl_osr.modules import categorical_inverse_dynamics

KEY = "loss_inverse_dynamics"


@pytest.mark.parametrize("one_hot", [True, False])
@pytest.mark.parametrize("states", ["both", "clean"])
def test_loss_and_gradient_equal_the_restatement(
    make_discrete_networks, make_discrete_batch, check, one_hot, states
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
    value.backward()
    parameters = loss.inverse_dynamics_network_params.values(True, True)
    got = [value, *(parameter.grad for parameter in parameters)]
    wanted = [expected, *wanted]
    check("Discrete inverse dynamics", got, wanted, tolerance=1e-12)


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
