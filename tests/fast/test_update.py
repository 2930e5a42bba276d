"""One update against the lines of a training loop that it stands for."""

from __future__ import annotations

import math

import pytest
import torch
from torch._dynamo.testing import CompileCounter
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss
from torchrl_osr.fast import FastUpdate, NonfiniteError, fuse_critics
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

CELLS = {"num_cells": [8]}
STEPS = 7


def make_loss() -> OSRLoss:
    torch.manual_seed(0)
    networks = tanh_gaussian_actor(3, 2, **CELLS), critic_ensemble(3, 2, **CELLS)
    model = tanh_gaussian_inverse_dynamics(3, 2, **CELLS)
    return OSRLoss(*networks, model, num_random=2).double()


def parts(loss) -> tuple[list, list]:
    """Parameters of the critics, and all others."""
    critics = list(loss.qvalue_network_params.parameters())
    known = set(critics)
    return critics, [each for each in loss.parameters() if each not in known]


def adam(params) -> torch.optim.Optimizer:
    return torch.optim.Adam(params, lr=1e-2, fused=True)


def soft(loss) -> SoftUpdate:
    return SoftUpdate(loss, tau=0.1)


def hard(loss) -> HardUpdate:
    return HardUpdate(loss, value_network_update_interval=2)


def assert_same(loss, other) -> None:
    pairs = zip(loss.state_dict().values(), other.state_dict().values(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)


@pytest.mark.parametrize("trace", [False, True])
@pytest.mark.parametrize("delay", [1, 3])
@pytest.mark.parametrize("updater", [soft, hard])
def test_it_is_a_loop_with_two_optimizers(make_batch, trace, delay, updater) -> None:
    loss, plain = make_loss(), make_loss()
    fuse_critics(plain)
    critics, policy = parts(loss)
    update = FastUpdate(
        loss, adam([{"params": critics}, {"params": policy}]), updater(loss),
        policy_delay=delay, policy_params=policy, trace=trace, warm_up=1,
    )  # fmt: skip
    torch.manual_seed(3)
    returned = [update(make_batch(5).clone()) for _ in range(STEPS)]
    critics, policy = parts(plain)
    first, second, targets = adam(critics), adam(policy), updater(plain)
    torch.manual_seed(3)
    for step in range(1, STEPS + 1):
        losses = plain(make_batch(5))
        of_critics = losses["loss_qvalue"] + losses["loss_cql"]
        of_critics.backward(inputs=critics, retain_graph=True)
        (losses["loss_actor"] + losses["loss_alpha"]).backward(inputs=policy)
        first.step()
        if step % delay == 0:
            second.step()
            targets.step()
        plain.zero_grad()
        torch.testing.assert_close(returned[step - 1], losses.detach(), rtol=0, atol=0)
    assert_same(loss, plain)
    assert not any(each.requires_grad for each in returned[-1].values())
    assert all(each.grad is None for each in loss.parameters())


@pytest.mark.parametrize("params", [(), "all"])
def test_a_delay_needs_something_to_delay_and_something_to_train(params) -> None:
    loss = InverseDynamicsLoss(tanh_gaussian_inverse_dynamics(3, 2, **CELLS))
    params = list(loss.parameters()) if params else params
    with pytest.raises(ValueError, match="policy_delay=2 needs policy_params"):
        FastUpdate(loss, adam(loss.parameters()), policy_delay=2, policy_params=params)


def test_only_the_losses_are_computed_in_half_precision(
    make_batch, monkeypatch
) -> None:
    loss, seen, original = make_loss().float(), set(), torch.nn.Linear.forward

    def forward(layer, inputs):
        out = original(layer, inputs)
        seen.add(out.dtype)
        return out

    monkeypatch.setattr(torch.nn.Linear, "forward", forward)
    optimizer, dtype = adam(loss.parameters()), torch.bfloat16
    losses = FastUpdate(loss, optimizer, soft(loss), autocast_dtype=dtype)(
        make_batch(5).apply(lambda x: x.float() if x.dtype.is_floating_point else x)
    )
    assert seen == {dtype}
    assert losses["loss_qvalue"].dtype == torch.float32


@pytest.mark.parametrize("trace", [False, True])
def test_a_batch_that_is_not_finite_changes_nothing(make_batch, trace) -> None:
    loss, before = make_loss(), make_loss()
    updates = [
        FastUpdate(each, adam(each.parameters()), soft(each), trace=trace, warm_up=1)
        for each in (loss, before)
    ]
    for update in updates:
        torch.manual_seed(3)
        for _ in range(4):
            update(make_batch(5))
    bad = make_batch(5)
    bad["next", "reward"][0] = math.inf
    match = "not finite: losses loss_qvalue.*; gradients qvalue_network_params"
    with pytest.raises(NonfiniteError, match=match) as raised:
        updates[0](bad)
    assert math.isfinite(raised.value.losses["loss_actor"])
    assert_same(loss, before)
    assert all(each.grad is None for each in loss.parameters())


def test_a_gradient_of_a_finite_loss_is_named(make_batch) -> None:
    loss = InverseDynamicsLoss(tanh_gaussian_inverse_dynamics(3, 2, **CELLS).double())
    name, parameter = next(iter(loss.named_parameters()))
    original = loss.forward

    def forward(batch):
        losses = original(batch)
        losses["loss_root"] = (0 * parameter).square().sum().sqrt()
        return losses

    loss.forward = forward
    with pytest.raises(NonfiniteError, match=f"losses none; gradients {name}"):
        FastUpdate(loss, adam(loss.parameters()))(make_batch(5))


# What tensordict 0.14.3 and torch.compile print when they trace.
@pytest.mark.filterwarnings("ignore:Using lock_:UserWarning")
@pytest.mark.filterwarnings("ignore:.*autograd.function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
def test_a_compiled_loss_is_traced_by_the_compiler_alone(make_batch) -> None:
    torch._dynamo.reset()
    graphs, states = CompileCounter(), []
    for is_compiled in (True, False):
        loss = make_loss()
        if is_compiled:
            loss.compile(backend=graphs, fullgraph=True)
        update = FastUpdate(loss, adam(loss.parameters()), soft(loss), warm_up=1)
        torch.manual_seed(3)
        for _ in range(4):
            update(make_batch(5))
        states.append(loss.state_dict().values())
    assert graphs.frame_count == 1
    for ours, theirs in zip(*states, strict=True):
        torch.testing.assert_close(ours, theirs)
