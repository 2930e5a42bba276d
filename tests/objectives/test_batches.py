"""What a loss does with its batch: masks, weights, the entries it leaves alone."""

from __future__ import annotations

import copy

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss

NAMES = ["osr", "cql", "osrv", "idm"]
MODES = ["osr", "cql", "osrv"]


def build(name: str, networks, **kwargs):
    if name == "idm":
        kwargs.pop("scalar_output_mode", None)
        return InverseDynamicsLoss(networks.inverse_dynamics, **kwargs)
    kwargs |= {"num_random": 3, "alpha_init": 0.5}
    kwargs["recovery_weight"] = 0.5 * (name != "cql")
    loss_class = OSRVLoss if name == "osrv" else OSRLoss
    loss = loss_class(
        networks.actor, networks.critics, networks.inverse_dynamics, **kwargs
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


def losses_and_gradients(loss, batch):
    torch.manual_seed(2)
    losses = {k: v for k, v in loss(batch).items() if k.startswith("loss_")}
    parameters = list(loss.parameters())
    total = sum(value.sum() for value in losses.values())
    return [*losses.values(), *torch.autograd.grad(total, parameters)]


def assert_same(got, wanted, tolerance: float = 1e-12) -> None:
    for ours, theirs in zip(got, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_padding_changes_neither_losses_nor_gradients(
    make_networks, make_batch, name, reduction
) -> None:
    mode = "exclude" if reduction == "none" else None
    loss = build(name, make_networks(), reduction=reduction, scalar_output_mode=mode)
    batch = make_batch(2, 5)
    mask = torch.ones(2, 5, 1, dtype=torch.bool)
    mask[:, 3:] = False
    batch["collector", "mask"] = mask
    spoiled, padding = batch.clone(), ~mask.squeeze(-1)
    for key in ("observation", ("next", "observation"), ("perturbed", "observation")):
        spoiled[key][padding] = 30.0
    spoiled["action"][padding] = 0.99
    spoiled["next", "reward"][padding] = -1e6
    spoiled["next", "done"][padding] = False
    wanted = losses_and_gradients(loss, batch)
    assert_same(losses_and_gradients(loss, spoiled), wanted)
    # Without the mask the same garbage does show.
    del spoiled["collector"]
    with pytest.raises(AssertionError):
        assert_same(losses_and_gradients(loss, spoiled), wanted)


@pytest.mark.parametrize("name", NAMES)
def test_mean_is_over_unmasked_rows(make_networks, make_batch, name) -> None:
    batch = make_batch(10)
    batch["collector", "mask"] = torch.arange(10).reshape(10, 1) < 6
    done, valid = batch["next", "done"].squeeze(-1), torch.arange(10) < 6
    mean = build(name, make_networks())
    each = build(name, make_networks(), reduction="none", scalar_output_mode="exclude")
    torch.manual_seed(2)
    rows = each(batch.exclude(("collector", "mask")))
    torch.manual_seed(2)
    out = mean(batch)
    for key in rows.keys():  # noqa: SIM118
        skips = key in ("loss_recovery", "loss_inverse_dynamics")
        counted = valid & ~done if skips else valid
        torch.testing.assert_close(out[key], rows[key][counted].mean())


@pytest.mark.parametrize("name", NAMES)
def test_batch_is_unchanged_but_for_the_priority(
    make_networks, make_batch, name
) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    before = batch.clone()
    # A batch straight from a buffer may carry what the networks write.
    batch["loc"], before["loc"] = torch.ones(10, 2), torch.ones(10, 2)
    loss(batch)
    new = set(batch.keys(True, True)) - set(before.keys(True, True))
    assert new == (set() if name == "idm" else {"td_error"})
    assert (batch.select(*before.keys(True, True)) == before).all()
    for key, value in batch.items(True, True):
        assert not value.requires_grad, key


@pytest.mark.parametrize("mode", MODES)
def test_rows_weigh_as_much_as_their_priority_weight(
    make_networks, make_batch, mode
) -> None:
    batch = make_batch(10)
    weight = torch.rand(10, dtype=torch.float64) + 0.1
    each = build(mode, make_networks(), reduction="none", scalar_output_mode="exclude")
    torch.manual_seed(2)
    rows = each(batch)
    batch["priority_weight"] = weight
    weighing = build(mode, make_networks())
    torch.manual_seed(2)
    out = weighing(batch)
    done = batch["next", "done"].squeeze(-1)
    for key in rows.keys():  # noqa: SIM118
        counted = weight * ~done if key == "loss_recovery" else weight
        expected = (rows[key] * counted).sum() / counted.sum()
        torch.testing.assert_close(out[key], expected)
    ignoring = build(mode, make_networks(), use_prioritized_weights=False)
    torch.manual_seed(2)
    out = ignoring(batch)
    torch.testing.assert_close(out["loss_qvalue"], rows["loss_qvalue"].mean())


@pytest.mark.parametrize("name", NAMES)
def test_copies_compute_the_same_and_train_apart(
    make_networks, make_batch, name
) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    wanted = losses_and_gradients(loss, batch)
    twin = copy.deepcopy(loss)
    assert_same(losses_and_gradients(twin, batch), wanted)
    for parameter in twin.parameters():
        parameter.data.add_(1.0)
    assert_same(losses_and_gradients(loss, batch), wanted)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_losses_have_the_batch_dtype(make_networks, make_batch, name, dtype) -> None:
    loss = build(name, make_networks()).to(dtype)
    batch = make_batch(10).apply(lambda t: t.to(dtype) if t.is_floating_point() else t)
    for value in losses_and_gradients(loss, batch):
        assert value.dtype == dtype
        assert value.isfinite().all()


@pytest.mark.parametrize("name", NAMES)
def test_order_of_the_rows_does_not_matter_to_the_model_terms(
    make_networks, make_batch, name
) -> None:
    # The terms without a random draw: recovery, likelihood, and the critics' values.
    loss, batch = build(name, make_networks()), make_batch(10)
    drawless = {"osr": "loss_recovery", "idm": "loss_inverse_dynamics"}
    key = drawless.get(name, "pred_value")
    out, flipped = loss(batch), loss(batch[torch.arange(9, -1, -1)])
    torch.testing.assert_close(out[key], flipped[key])
