"""The ensemble of dynamics models, its loss, and its elites for acting."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from uneven_dynamics import linear_dynamics, plain_gaussian

from torchrl_osr.lab.dynamics import DynamicsEnsemble, DynamicsLoss, EliteNetworks
from torchrl_osr.lab.dynamics.ensemble import has_next_state


def rows_of(state, action, change, reward) -> TensorDict:
    no = torch.zeros(len(state), 1, dtype=torch.bool)
    after = {"observation": state + change, "reward": reward, "terminated": no}
    batch = {"observation": state, "action": action, "next": after}
    return TensorDict(batch, [len(state)])


def test_elites_are_the_best_on_held_out_rows() -> None:
    model = linear_dynamics((1, 1), {}, (4, 2))
    # Predicted change; the truth is 1 and the reward 0.
    model.layers[0].bias[:, 0, 0] = torch.tensor([5.0, 1.1, -3.0, 0.8])
    ones, zeros = torch.ones(3, 1), torch.zeros(3, 1)
    model.calibrate_(rows_of(zeros, zeros, ones, zeros))
    assert model.elites.tolist() == [1, 3]
    # Their mean is .95, and both are .15 from it.
    apart = model.disagreement(model.predict(zeros, zeros)[0])
    assert apart.max().item() == pytest.approx(0.15)
    with pytest.raises(ValueError, match="num_elites must be between 1 and"):
        DynamicsEnsemble(1, 1, num_networks=3, num_elites=4)


def test_rows_without_a_next_state_and_constant_entries() -> None:
    state = torch.randn(50, 2)
    state[:, 1] = 3.0
    data = rows_of(state, state[:, :1], torch.zeros(50, 2), torch.ones(50, 1))
    data["next", "terminated"][:2] = True
    data["next", "observation"][1] += 1.0
    assert has_next_state(data)[:3].tolist() == [False, True, True]
    model = DynamicsEnsemble(2, 1, num_networks=1, num_elites=1)
    model.standardize_(data[2:])
    assert model.input_scale[1] == 1
    assert model.target_scale.tolist() == [1, 1, 1]
    assert model.target_loc.tolist() == [0, 0, 1]


def ensemble(*elites: int) -> DynamicsEnsemble:
    sizes = {"num_networks": 4, "num_elites": len(elites), "num_cells": [8, 8]}
    model = DynamicsEnsemble(3, 2, **sizes)
    model.elites.copy_(torch.tensor(elites))
    for name in ("input", "target"):
        getattr(model, f"{name}_loc").normal_()
        getattr(model, f"{name}_scale").uniform_(0.5, 2.0)
    return model


def test_elite_networks_predict_means_in_the_environments_units() -> None:
    model, loc = ensemble(1, 3), torch.tensor([1.0, -2.0, 300.0])
    scale = torch.tensor([2.0, 0.5, 40.0])
    low, high = torch.tensor([-2.0, 0.5]), torch.tensor([4.0, 1.5])
    networks = EliteNetworks(model, loc, scale, low, high)
    seen, unit = torch.randn(5, 3), 2 * torch.rand(5, 2) - 1
    mean = model.predict(seen, unit)[0][[1, 3]]
    wanted = torch.cat([mean[..., :3] * scale, mean[..., 3:]], -1)
    state, action = seen * scale + loc, low + (unit + 1) / 2 * (high - low)
    found = networks(state.expand(2, -1, -1), action.expand(2, -1, -1))
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    other = EliteNetworks(ensemble(0))
    both = EliteNetworks.join([other, networks])
    state, action = torch.randn(3, 5, 3), torch.randn(3, 5, 2)
    wanted = torch.cat([other(state[:1], action[:1]), networks(state[1:], action[1:])])
    torch.testing.assert_close(both(state, action), wanted)


def make_model(num_cells=(6, 5)) -> DynamicsEnsemble:
    torch.manual_seed(0)
    model = DynamicsEnsemble(3, 2, num_networks=2, num_elites=1, num_cells=num_cells)
    for each in model.parameters():
        nn.init.normal_(each, std=0.5)
    return model.double()


def plain_loss(model: DynamicsEnsemble, batch, weight: float) -> torch.Tensor:
    """Gaussian by Gaussian: (y - m)^2 / v + log v, each network on its own rows."""
    low, high = model.lowest_log_variance, model.highest_log_variance
    half = len(batch) // 2
    total = weight * (high.sum() - low.sum())
    for number in range(2):
        rows = batch[number * half : (number + 1) * half]
        counted, value = 0, 0.0
        for row in rows:
            after = row["next"]
            change = after["observation"] - row["observation"]
            if after["terminated"] and not change.any():
                continue
            inputs = row["observation"], row["action"]
            mean, variance = plain_gaussian(model, number, *inputs)
            truth = torch.cat([change, after["reward"]])
            truth = (truth - model.target_loc) / model.target_scale
            value += ((truth - mean) ** 2 / variance + torch.log(variance)).mean()
            counted += 1
        total = total + value / counted
    return total


@pytest.mark.parametrize("weight", [0.0, 2.0])
@pytest.mark.parametrize("num_cells", [(), (6, 5)])
def test_loss_and_gradients_equal_the_plain_likelihood(
    make_batch, check, weight, num_cells
) -> None:
    batch = make_batch(10, twin=False)
    ended = batch["next", "terminated"].squeeze(-1)  # a row of each network
    batch["next", "observation"][ended] = batch["observation"][ended]
    model, plain = make_model(num_cells), make_model(num_cells)
    for each in (model, plain):
        each.standardize_(batch)
    loss = DynamicsLoss(model, bound_weight=weight)
    value = sum(loss(batch).values())
    wanted = plain_loss(plain, batch, weight)
    check(
        "Dynamics ensemble",
        [value.detach(), *torch.autograd.grad(value, list(model.parameters()))],
        [wanted.detach(), *torch.autograd.grad(wanted, list(plain.parameters()))],
        tolerance=1e-10,
    )


def test_weights_alone_decay_and_by_their_layer() -> None:
    model, decays = make_model(), {}
    for group in model.parameter_groups():
        for each in group["params"]:
            decays[each] = group.get("weight_decay", 0.0)
    assert decays.keys() == set(model.parameters())
    first, second, last = (layer.weight for layer in model.layers)
    wanted = {first: 2.5e-5, second: 5e-5, last: 1e-4}
    assert {each: decay for each, decay in decays.items() if decay} == wanted


def test_a_model_learns_single_steps_and_divides_the_batch(make_batch) -> None:
    single = make_batch(10, twin=False)
    several = single.clone().set("next", single["next"].roll(1, 0))
    several["steps_to_next_obs"] = torch.full((10, 1), 5)
    loss = DynamicsLoss(make_model())
    with pytest.raises(ValueError, match="5 steps.*the model of the dynamics reads"):
        loss(several)
    kept = several.set("one_step", single["next"])
    assert torch.equal(loss(kept)["loss_dynamics"], loss(single)["loss_dynamics"])
    with pytest.raises(ValueError, match="9 rows cannot be divided among 2"):
        loss(make_batch(9, twin=False))
