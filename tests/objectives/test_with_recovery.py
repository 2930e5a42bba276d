"""A loss and the recovery term of its actor as one loss."""

from __future__ import annotations

import pytest
import torch
from torchrl.objectives import SoftUpdate
from torchrl_osr.objectives.with_recovery import WithRecovery

from torchrl_osr import StateRecoveryLoss
from torchrl_osr.lab.losses import ReBRACLoss


@pytest.fixture
def parts(make_networks, make_deterministic_actor):
    """Return a factory of a loss and the recovery term of its actor."""

    def make() -> tuple[ReBRACLoss, StateRecoveryLoss]:
        networks = make_networks()
        actor = make_deterministic_actor("module")
        loss = ReBRACLoss(actor, networks.critics, critic_bc_coef=0.0).double()
        SoftUpdate(loss, tau=0.1)
        return loss, StateRecoveryLoss(actor, networks.inverse_dynamics).double()

    return make


def total(losses):
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def test_it_returns_what_both_do_and_trains_the_sum(parts, make_batch) -> None:
    batch, (loss, recovery) = make_batch(10), parts()
    torch.manual_seed(5)
    wanted = {**loss(batch), **recovery(batch)}
    total(wanted).backward()
    wanted_grads = {id(each): each.grad for each in loss.parameters()}
    both = WithRecovery(*parts())
    torch.manual_seed(5)
    out = both(batch.select(*both.in_keys))
    assert list(out.keys()) == both.out_keys
    assert out.keys() == wanted.keys()
    assert all(torch.equal(out[key], wanted[key]) for key in wanted)
    total(out).backward()
    grads = [each.grad for each in both.parameters()]
    assert len(grads) == len(wanted_grads), "what they share counts once"
    for ours, theirs in zip(grads, wanted_grads.values(), strict=True):
        assert torch.equal(ours, theirs)


def test_a_state_dict_brings_both_back(parts, make_batch) -> None:
    first, second = WithRecovery(*parts()), WithRecovery(*parts())
    optimizer = torch.optim.SGD(first.parameters(), lr=0.1)
    total(first(make_batch(10))).backward()
    optimizer.step()
    second.load_state_dict(first.state_dict())
    shared = [id(each) for each in second.loss.actor_network_params.parameters()]
    again = [id(each) for each in second.recovery.actor_network_params.parameters()]
    assert shared == again
    for ours, theirs in zip(second.parameters(), first.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_another_actor_is_refused(parts) -> None:
    with pytest.raises(ValueError, match="of another actor than the loss's"):
        WithRecovery(parts()[0], parts()[1])
