"""The ensemble of dynamics models: its products, and worlds whose answer is known."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_osr.lab.dynamics import DynamicsEnsemble, DynamicsLoss
from torchrl_osr.lab.dynamics.ensemble import has_next_state


def rows_of(state, action, change, reward) -> TensorDict:
    no = torch.zeros(len(state), 1, dtype=torch.bool)
    after = {"observation": state + change, "reward": reward}
    after |= {"done": no, "terminated": no.clone(), "truncated": no.clone()}
    batch = {"observation": state, "action": action, "next": after}
    return TensorDict(batch, [len(state)])


def fit(model: DynamicsEnsemble, data: TensorDict, *, steps: int, rows: int, lr: float):
    """Train with MOPO's weight decay; the learning rate falls to 0."""
    model.standardize_(data)
    loss = DynamicsLoss(model)
    optimizer = torch.optim.Adam(list(model.parameter_groups()), lr=lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        batch = data[torch.randint(len(data), [rows * model.num_networks])]
        sum(loss(batch).values()).backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()


def plain_network(model: DynamicsEnsemble, number: int) -> nn.Sequential:
    """One network of the ensemble as PyTorch's own layers."""
    layers: list[nn.Module] = []
    for stacked in model.layers:
        layer = nn.Linear(*stacked.weight.shape[1:]).double()
        layer.weight.data = stacked.weight[number].T
        layer.bias.data = stacked.bias[number, 0]
        layers += [layer, nn.SiLU()]
    return nn.Sequential(*layers[:-1])


@pytest.mark.parametrize("num_cells", [[], [7], [6, 5, 4]])
def test_stacked_products_are_those_of_the_networks_one_by_one(num_cells) -> None:
    model = DynamicsEnsemble(3, 2, num_networks=4, num_elites=2, num_cells=num_cells)
    model.double()
    for each in model.parameters():  # biases begin at 0
        nn.init.normal_(each, std=0.5)
    state, action = torch.randn(9, 3).double(), torch.randn(9, 2).double()
    got = model.predict(state, action)
    inputs = torch.cat([state, action], -1)
    low, high = model.lowest_log_variance, model.highest_log_variance
    for number in range(4):
        mean, free = plain_network(model, number)(inputs).chunk(2, -1)
        bounded = high - torch.log1p(torch.exp(high - free))
        bounded = low + torch.log1p(torch.exp(bounded - low))
        torch.testing.assert_close(got.mean[number], mean, rtol=0, atol=1e-12)
        deviation = torch.exp(bounded / 2)
        torch.testing.assert_close(got.scale[number], deviation, rtol=0, atol=1e-12)
    batch = TensorDict({"observation": state, "action": action}, [9])
    assert torch.equal(model(batch)["loc"], got.mean.movedim(0, 1))
    each_own = model.standardized(inputs.expand(4, 9, 5))[0]
    torch.testing.assert_close(each_own, got.mean, rtol=0, atol=1e-12)


def test_ensemble_recovers_a_linear_gaussian_world() -> None:
    torch.manual_seed(1)
    number, noise = 20_000, torch.tensor([0.1, 0.3, 0.2])
    weight = torch.tensor([[-0.3, 0.2, 0.5], [0.1, -0.4, -0.2], [0.7, 0.3, 0.1]])
    offset = torch.tensor([0.2, -1.0, 0.4])
    state, action = torch.randn(number, 2), 2 * torch.rand(number, 1) - 1
    inputs = torch.cat([state, action], -1)
    exact = inputs @ weight.T + offset
    drawn = exact + noise * torch.randn_like(exact)
    data = rows_of(state, action, drawn[:, :2], drawn[:, 2:])
    model = DynamicsEnsemble(2, 1, num_networks=3, num_elites=3, num_cells=[8])
    fit(model, data, steps=600, rows=400, lr=2e-2)
    # Not the outermost: at the edge there are no rows to learn from.
    inner = (inputs.abs() < 1.5).all(-1)
    with torch.no_grad():
        mean, scale = model.predict(state[inner], action[inner])
    error = (mean.mean(0) - exact[inner]).square().mean(0).sqrt()
    assert (error < 1e-2).all(), error
    variance = scale.square().mean((0, 1)) / noise.square()
    assert ((variance - 1).abs() < 0.05).all(), variance


def test_disagreement_grows_off_the_data() -> None:
    state, action = 2 * torch.rand(2000, 1) - 1, 2 * torch.rand(2000, 1) - 1
    change = torch.sin(3 * state) * action + 0.01 * torch.randn(2000, 1)
    data = rows_of(state, action, change, action.clone())
    model = DynamicsEnsemble(1, 1, num_networks=5, num_elites=5, num_cells=[32, 32])
    fit(model, data, steps=500, rows=64, lr=1e-2)
    apart = []
    for distance in (0.0, 1.0, 2.0, 4.0):
        at = torch.full([200, 1], distance)
        with torch.no_grad():
            mean, _ = model.predict(at, torch.linspace(-1, 1, 200)[:, None])
        apart.append(model.disagreement(mean).mean().item())
    assert apart[2] > 5 * apart[0], apart
    assert apart[3] > 2 * apart[2], apart


def test_elites_are_the_best_on_held_out_rows() -> None:
    model = DynamicsEnsemble(1, 1, num_networks=4, num_elites=2, num_cells=[])
    with torch.no_grad():
        model.layers[0].weight.zero_()
        # Predicted change; the truth is 1 and the reward 0.
        model.layers[0].bias[:, 0, 0] = torch.tensor([5.0, 1.1, -3.0, 0.8])
    ones, zeros = torch.ones(3, 1), torch.zeros(3, 1)
    model.calibrate_(rows_of(zeros, zeros, ones, zeros))
    assert model.elites.tolist() == [1, 3]
    # Their mean is .95, and both are .15 from it.
    apart = model.disagreement(model.predict(zeros, zeros).mean)
    assert apart.max().item() == pytest.approx(0.15)


def test_a_repeated_state_is_no_next_state() -> None:
    state, no_change = torch.randn(4, 2), torch.zeros(4, 2)
    data = rows_of(state, state[:, :1], no_change, state[:, :1])
    data["next", "terminated"][:2] = True
    data["next", "observation"][1] += 1.0
    assert has_next_state(data).tolist() == [False, True, True, True]


def test_entries_that_do_not_vary_stay_as_they_are() -> None:
    state = torch.randn(50, 2)
    state[:, 1] = 3.0
    data = rows_of(state, state[:, :1], torch.zeros(50, 2), torch.ones(50, 1))
    model = DynamicsEnsemble(2, 1, num_networks=1, num_elites=1)
    model.standardize_(data)
    assert model.input_scale[1] == 1
    assert model.target_scale.tolist() == [1, 1, 1]
    assert model.target_loc.tolist() == [0, 0, 1]
    assert model.predict(state, state[:, :1]).mean.isfinite().all()


@pytest.mark.parametrize("elites", [0, 4])
def test_number_of_elites_is_checked(elites) -> None:
    with pytest.raises(ValueError, match="num_elites must be between 1 and"):
        DynamicsEnsemble(1, 1, num_networks=3, num_elites=elites)
