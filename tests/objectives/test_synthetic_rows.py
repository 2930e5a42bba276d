"""Rows of a model, in which the policy itself acts, are not cloned."""

from __future__ import annotations

import pytest
import torch

from torchrl_osr.lab.losses import BCLoss

# What is to be learned from the data's actions, or where they led.
TERMS = {
    "osr": "loss_actor",
    "official": "loss_actor",
    "noisy-cloning": "loss_actor",
    "discrete": "loss_actor",
    "osrv": "recovery_gap",
    "recovery": "loss_recovery",
    "recovery-plain": "loss_recovery",
    "scas": "loss_actor",
    "td3bc": "loss_actor",
    "rebrac": "loss_actor",
}


@pytest.mark.parametrize(("name", "key"), TERMS.items())
def test_synthetic_rows_are_not_imitated(
    family, family_batch, seeded, name, key
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    other = batch.clone()
    other["action"][6:] = batch["action"][:4]
    other["next", "observation"][6:] = batch["next", "observation"][:4]
    assert not torch.equal(seeded(loss, other)[key], seeded(loss, batch)[key])
    for each in (batch, other):
        each["imagined"] = torch.arange(10).unsqueeze(-1) >= 6
    assert torch.equal(seeded(loss, other)[key], seeded(loss, batch)[key])


@pytest.mark.parametrize("name", ["td3bc", "rebrac"])
def test_cloning_is_left_out_row_by_row(family, family_batch, seeded, name) -> None:
    loss, batch = family(name, reduction="none"), family_batch(name, 10)
    everywhere = seeded(loss, batch)["loss_actor"]
    batch["imagined"] = torch.arange(10).unsqueeze(-1) >= 6
    ours = seeded(loss, batch)["loss_actor"]
    assert torch.equal(ours[:6], everywhere[:6])
    assert (ours[6:] < everywhere[6:]).all(), "a squared distance less"
    # What is logged is that of the rows that are cloned.
    whole, rows = family(name), family_batch(name, 10)[:6]
    error = seeded(whole, batch)["cloning_error"]
    torch.testing.assert_close(error, seeded(whole, rows)["cloning_error"])


def test_a_constraint_and_cloning_alone_leave_them_out(
    family, family_batch, seeded, make_networks, make_batch
) -> None:
    sdc = family("sdc", reduction="none"), family_batch("sdc", 10), "loss_deviation"
    bc = BCLoss(make_networks().actor, reduction="none").double(), make_batch(10)
    for loss, batch, key in (sdc, (*bc, "loss_actor")):
        everywhere = seeded(loss, batch)[key]
        batch["imagined"] = torch.arange(10).unsqueeze(-1) >= 6
        ours = seeded(loss, batch)[key]
        assert torch.equal(ours[:6], everywhere[:6])
        assert (everywhere[6:] != 0).all()
        assert (ours[6:] == 0).all()
