"""The critics' target: its kinds, its discount, and returns of several steps."""

from __future__ import annotations

import pytest
import torch
from objectives.losses import (
    WITH_CRITICS,
    assert_same,
    call,
    make_batch,
    make_loss,
    parts,
    record,
    with_critics,
)
from torchrl.data.postprocs import MultiStep


@with_critics
def test_target_follows_the_discount(name) -> None:
    loss, batch, found = make_loss(name), make_batch(name, 2, 5), []
    for gamma in (0.0, 0.5, 1.0):
        loss.make_value_estimator(gamma=gamma)
        found.append(call(loss, batch)["target_value"])
    zero, half, one = found
    torch.testing.assert_close(zero, batch["next", "reward"].mean())
    torch.testing.assert_close(half, (zero + one) / 2)
    with pytest.raises(NotImplementedError):
        loss.make_value_estimator("tdlambda")


@with_critics
def test_a_return_of_one_step_changes_nothing(name) -> None:
    loss, batch = make_loss(name), make_batch(name, 2, 5)
    assert_same(record(loss, MultiStep(0.875, 1)(batch.clone())), record(loss, batch))


# Those that read the next state as the one an action leads to, and the term that does.
SINGLE = {"osr": "recovery_kl", "osr-v": "recovery_gap", "discrete": "recovery_kl"}
SINGLE |= {"recovery": "loss_recovery", "official": "loss_recovery"}
SINGLE |= {"model": "loss_inverse_dynamics"}


@pytest.mark.parametrize(("name", "key"), SINGLE.items())
def test_models_read_single_steps_kept_beside_those_of_several(name, key) -> None:
    single = make_batch(name, 30, ends=False)
    several = single.clone().set("next", single["next"].roll(1, 0))
    several["steps_to_next_obs"] = torch.full((30, 1), 2)
    several["next", "done"][:9] = True
    loss = make_loss(name)
    with pytest.raises(
        ValueError, match=r"multi-step .*\(2 steps\).*leave MultiStep out"
    ):
        loss(several)
    both = several.clone().set("one_step", single["next"])
    assert torch.equal(call(loss, both)[key], call(loss, single)[key])
    if name in WITH_CRITICS:
        parts(loss)[0].make_value_estimator(gamma=0.5)
        found = call(loss, both)["target_value"]
        parts(loss)[0].make_value_estimator(gamma=0.25)
        several["steps_to_next_obs"].fill_(1)
        torch.testing.assert_close(found, call(loss, several)["target_value"])
