"""One update against the lines of a training loop that it stands for."""

from __future__ import annotations

import pickle

import pytest
import torch
from objectives.losses import Networks, assert_same_bits, call, make_batch, make_loss
from torch._dynamo.testing import CompileCounter
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_osr import CQLLoss
from torchrl_osr.fast import FastUpdate, NonfiniteError, fuse_critics
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor

STEPS = 7


def parts(loss) -> tuple[list, list]:
    """Parameters of the critics, and all others."""
    critics = [*loss.qvalue_network_params.parameters()]
    return critics, [each for each in loss.parameters() if each not in {*critics}]


def adam(params) -> torch.optim.Optimizer:
    return torch.optim.Adam(params, lr=1e-2, fused=True)


def soft(loss) -> SoftUpdate:
    return SoftUpdate(loss, tau=0.1)


def hard(loss) -> HardUpdate:
    return HardUpdate(loss, value_network_update_interval=2)


@pytest.mark.parametrize("trace", [False, True])
@pytest.mark.parametrize("delay", [1, 3])
@pytest.mark.parametrize("updater", [soft, hard])
def test_it_is_a_loop_with_two_optimizers(trace, delay, updater) -> None:
    networks = Networks(low=-torch.ones(2), high=torch.ones(2))
    loss, plain = make_loss("osr", networks), make_loss("osr")
    fuse_critics(plain)
    critics, policy = parts(loss)
    update = FastUpdate(
        loss, adam([{"params": critics}, {"params": policy}]), updater(loss),
        policy_delay=delay, policy_params=policy, trace=trace, warm_up=1,
    )  # fmt: skip
    torch.manual_seed(3)
    returned = [update(make_batch("osr", 5).clone()) for _ in range(STEPS)]
    critics, policy = parts(plain)
    first, second, targets = adam(critics), adam(policy), updater(plain)
    torch.manual_seed(3)
    for step in range(1, STEPS + 1):
        losses = plain(make_batch("osr", 5))
        of_critics = losses["loss_qvalue"] + losses["loss_cql"]
        of_critics.backward(inputs=critics, retain_graph=True)
        (losses["loss_actor"] + losses["loss_alpha"]).backward(inputs=policy)
        first.step()
        if step % delay == 0:
            second.step()
            targets.step()
        plain.zero_grad()
        torch.testing.assert_close(returned[step - 1], losses.detach(), rtol=0, atol=0)
    assert_same_bits([*loss.state_dict().values()], [*plain.state_dict().values()])
    assert all(bool(each.trace) is trace for each in update.gradients)
    assert not any(each.requires_grad for each in returned[-1].values())
    assert all(each.grad is None for each in loss.parameters())


@pytest.mark.parametrize("params", [(), "all"])
def test_a_delay_needs_something_to_delay_and_something_to_train(params) -> None:
    loss = make_loss("model")
    params = list(loss.parameters()) if params else params
    with pytest.raises(ValueError, match="policy_delay=2 needs policy_params"):
        FastUpdate(loss, adam(loss.parameters()), policy_delay=2, policy_params=params)


def test_a_parameter_may_be_frozen_between_delayed_updates() -> None:
    loss = make_loss("osr").float()
    delayed = [*loss.actor_network_params.parameters()]
    options = {"policy_delay": 2, "policy_params": delayed}
    update = FastUpdate(loss, adam(loss.parameters()), soft(loss), **options)
    frozen = next(loss.qvalue_network_params.parameters()).requires_grad_(False)
    before = frozen.clone()
    for _ in range(2):
        update(make_batch("osr", 5).float())
    assert torch.equal(frozen, before)


def test_bounds_that_are_numbers_stay_as_they_are() -> None:
    actor, critics = (
        tanh_gaussian_actor(3, 2, low=-0.4, high=0.7),
        critic_ensemble(3, 2),
    )
    loss = CQLLoss(actor.double(), [each.double() for each in critics])
    FastUpdate(loss, adam(loss.parameters()))
    head = loss.actor_network[-1].distribution_kwargs
    assert (head["low"], head["high"]) == (-0.4, 0.7)


def test_the_losses_alone_are_computed_in_half_precision() -> None:
    loss, plain = (make_loss("osr").float() for _ in range(2))
    fuse_critics(plain)
    optimizer, batch = adam(loss.parameters()), make_batch("osr", 5)
    update = FastUpdate(loss, optimizer, soft(loss), autocast_dtype=torch.bfloat16)
    found = call(update, batch)
    with torch.autocast("cpu", torch.bfloat16):
        wanted = call(plain, batch).detach()
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)


def test_a_gradient_of_a_finite_loss_is_named() -> None:
    loss = make_loss("model")
    name, parameter = next(iter(loss.named_parameters()))
    original = loss.forward

    def forward(batch):
        losses = original(batch)
        losses["loss_root"] = (0 * parameter).square().sum().sqrt()
        return losses

    loss.forward = forward
    with pytest.raises(NonfiniteError, match=f"losses none; gradients {name}") as end:
        FastUpdate(loss, adam(loss.parameters()))(make_batch("osr", 5))
    assert str(pickle.loads(pickle.dumps(end.value))) == str(end.value)


# What tensordict 0.14.3 and torch.compile print when they trace.
@pytest.mark.filterwarnings("ignore:Using lock_:UserWarning")
@pytest.mark.filterwarnings("ignore:.*autograd.function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
def test_a_compiled_loss_is_traced_by_the_compiler_alone() -> None:
    torch._dynamo.reset()
    graphs, states = CompileCounter(), []
    for is_compiled in (True, False):
        loss = make_loss("osr")
        if is_compiled:
            loss.compile(backend=graphs, fullgraph=True)
        update = FastUpdate(loss, adam(loss.parameters()), soft(loss), warm_up=1)
        torch.manual_seed(3)
        for _ in range(4):
            update(make_batch("osr", 5))
        states.append(loss.state_dict().values())
    assert graphs.frame_count == 1
    for ours, theirs in zip(*states, strict=True):
        torch.testing.assert_close(ours, theirs)
