"""BCLoss against torch.distributions."""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Normal

from torchrl_osr.lab.losses import BCLoss

STATES = ["clean", "perturbed", "both"]


@pytest.mark.parametrize("kind", ["tanh", "delta", "module"])
@pytest.mark.parametrize("states", STATES)
def test_value_and_gradients_equal_the_restatement(
    make_networks, make_deterministic_actor, make_batch, check, kind, states
) -> None:
    def make():
        tanh = kind == "tanh"
        return make_networks().actor if tanh else make_deterministic_actor(kind)

    actor, plain, batch = make(), make(), make_batch(10)
    sets = {"clean": "observation", "perturbed": ("perturbed", "observation")}
    names = ["clean", "perturbed"] if states == "both" else [states]
    s = torch.cat([batch[sets[name]] for name in names])
    a = batch["action"].repeat(len(names), 1)
    if kind == "tanh":
        density = Normal(*plain.module[0](s)[1:])
        expected = -(density.log_prob(a.atanh()) - (1 - a**2).log()).sum(-1).mean()
    else:
        mlp = plain.module[0].module if kind == "delta" else plain.module[0]
        expected = (torch.tanh(mlp(s)) - a).norm(dim=-1).square().mean()
    gradients = torch.autograd.grad(expected, list(plain.parameters()))
    loss = BCLoss(actor, states=states).double()
    value = loss(batch)["loss_actor"]
    value.backward()
    got = [value.detach(), *(each.grad for each in loss.parameters())]
    label = "Behaviour cloning" if states == "clean" else "Noisy behaviour cloning"
    check(label, got, [expected.detach(), *gradients], tolerance=1e-10)


def test_only_what_it_needs_is_read(make_networks, make_batch) -> None:
    loss, batch = BCLoss(make_networks().actor).double(), make_batch(10)
    assert loss.in_keys == ["observation", "action"]
    before = set(batch.keys(True))
    assert torch.equal(
        loss(batch)["loss_actor"], loss(batch.select(*loss.in_keys))["loss_actor"]
    )
    assert set(batch.keys(True)) == before
    with pytest.raises(KeyError, match="No perturbed state"):
        BCLoss(make_networks().actor, states="both")(batch.select(*loss.in_keys))


def test_masks_and_weights_count(make_networks, make_batch) -> None:
    loss, batch = BCLoss(make_networks().actor).double(), make_batch(10)
    rows = BCLoss(make_networks().actor, reduction="none").double()(batch)["loss_actor"]
    weight = torch.linspace(0, 2, 10, dtype=torch.float64)
    batch["priority_weight"] = weight
    weighted = (rows * weight).sum() / weight.sum()
    torch.testing.assert_close(loss(batch)["loss_actor"], weighted)
    kept = torch.arange(10) % 3 > 0
    batch["collector", "mask"] = kept
    masked = (rows * weight)[kept].sum() / weight[kept].sum()
    torch.testing.assert_close(loss(batch)["loss_actor"], masked)


def test_an_action_of_another_size_is_refused(make_networks, make_batch) -> None:
    batch = make_batch(4)
    batch["action"] = batch["action"][:, :1]
    with pytest.raises(ValueError, match="actions have 2 dimensions"):
        BCLoss(make_networks().actor).double()(batch)
