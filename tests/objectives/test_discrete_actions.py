"""Discrete actions in every form that a batch may have them in, and impossible ones."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Categorical
from torch.distributions import OneHotCategorical as TorchOneHotCategorical

FORMS = {
    "int64 [B]": lambda index: index,
    "int32 [B, 1]": lambda index: index.int().unsqueeze(-1),
    "uint8 [B]": lambda index: index.byte(),
}

both_losses = pytest.mark.losses("discrete", "discrete-idm")


@both_losses
@pytest.mark.parametrize("form", FORMS)
def test_indices_and_one_hot_vectors_give_the_same_numbers(
    family, family_batch, record, assert_same_bits, name, form
) -> None:
    batch = family_batch(name, 2, 5)
    wanted = record(family(name), batch)
    networks = family.networks(name, distribution_class=Categorical)
    batch["action"] = FORMS[form](batch["action"].argmax(-1))
    assert_same_bits(record(family(name, networks), batch), wanted)


@both_losses
@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64, torch.float32])
@pytest.mark.parametrize("torchs", [False, True], ids=["torchrl", "torch"])
def test_one_hot_vectors_may_be_of_any_type(
    family, family_batch, record, assert_same_bits, name, dtype, torchs
) -> None:
    batch = family_batch(name, 10)
    wanted = record(family(name), batch)
    kwargs = {"distribution_class": TorchOneHotCategorical} if torchs else {}
    loss = family(name, family.networks(name, **kwargs))
    batch["action"] = batch["action"].to(dtype)
    assert_same_bits(record(loss, batch), wanted)


def test_an_action_that_is_never_taken_leaves_all_finite(
    family, family_batch, record
) -> None:
    networks = family.networks("discrete")
    for network in (networks.actor, networks.inverse_dynamics):
        network[0].module[-1].bias.data[2] = -math.inf
    for value in record(family("discrete", networks), family_batch("discrete", 10)):
        # The bias itself cannot be moved by a step, but must not spoil the others.
        assert value.isfinite().all()
