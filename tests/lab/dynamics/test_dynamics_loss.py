"""DynamicsLoss against a plain restatement, network by network and row by row."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_osr.lab.dynamics import DynamicsEnsemble, DynamicsLoss


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
            if after["terminated"] and torch.equal(
                after["observation"], row["observation"]
            ):
                continue
            hidden = torch.cat([row["observation"], row["action"]])
            hidden = (hidden - model.input_loc) / model.input_scale
            for layer in model.layers[:-1]:
                hidden = layer.weight[number].T @ hidden + layer.bias[number, 0]
                hidden = hidden * torch.sigmoid(hidden)
            last = model.layers[-1]
            out = last.weight[number].T @ hidden + last.bias[number, 0]
            truth = torch.cat(
                [after["observation"] - row["observation"], after["reward"]]
            )
            truth = (truth - model.target_loc) / model.target_scale
            free = high - torch.log(1 + torch.exp(high - out[4:]))
            variance = torch.exp(low + torch.log(1 + torch.exp(free - low)))
            value += ((truth - out[:4]) ** 2 / variance + torch.log(variance)).mean()
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


def test_decay_is_half_the_squared_norm_of_the_weights(make_batch) -> None:
    """Adam's weight decay and MOPO's term of the loss give the same step."""
    batch, models = make_batch(10, twin=False), [make_model(), make_model()]
    first, second = (DynamicsLoss(each) for each in models)
    sum(first(batch).values()).backward()
    decays = [2.5e-5, 5e-5, 1e-4]
    term = sum(
        decay * layer.weight.square().sum() / 2
        for decay, layer in zip(decays, models[1].layers, strict=True)
    )
    (sum(second(batch).values()) + term).backward()
    torch.optim.SGD(list(models[0].parameter_groups()), lr=1.0).step()
    torch.optim.SGD(models[1].parameters(), lr=1.0).step()
    for one, other in zip(models[0].parameters(), models[1].parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)


def test_a_model_learns_single_steps_and_divides_the_batch(make_batch) -> None:
    single = make_batch(10, twin=False)
    several = single.clone().set("next", single["next"].roll(1, 0))
    several["steps_to_next_obs"] = torch.full((10, 1), 5)
    loss = DynamicsLoss(make_model())
    with pytest.raises(ValueError, match="5 steps.*the model of the dynamics reads"):
        loss(several)
    kept = several.set("one_step", single["next"])
    assert torch.equal(loss(kept)["loss_dynamics"], loss(single)["loss_dynamics"])
    with pytest.raises(ValueError, match="9 rows for 2 networks"):
        loss(make_batch(9, twin=False))
