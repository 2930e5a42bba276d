"""The same numbers with and without vmap, and with and without torch.compile."""

from __future__ import annotations

import inspect

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss

MODES = ["osr", "cql", "osrv", "osrv-logsumexp"]


def build(mode: str, networks, **kwargs) -> OSRLoss | OSRVLoss:
    loss_class = OSRVLoss if mode.startswith("osrv") else OSRLoss
    if mode == "osrv-logsumexp":
        kwargs["policy_values"] = "logsumexp"
    loss = loss_class(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        recovery_weight=0.0 if mode == "cql" else 0.5,
        **({"num_random": 3} | kwargs),
    ).double()
    loss.make_value_estimator(gamma=0.99)
    SoftUpdate(loss, tau=0.1)
    return loss


def losses_and_gradients(loss, parameters, batch) -> list[torch.Tensor]:
    torch.manual_seed(2)
    losses = [v for k, v in loss(batch).items() if k.startswith("loss_")]
    return [*losses, *torch.autograd.grad(sum(losses), list(parameters))]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("count", [1, 3])
def test_a_loop_over_critics_equals_vmap(
    make_networks, make_batch, mode, count
) -> None:
    results = []
    for deactivate in (False, True):
        loss = build(mode, make_networks(num_critics=count), deactivate_vmap=deactivate)
        results.append(losses_and_gradients(loss, loss.parameters(), make_batch(10)))
    for looped, mapped in zip(*results, strict=True):
        torch.testing.assert_close(looped, mapped, rtol=1e-12, atol=1e-12)


# Raised inside tensordict 0.14.3 and TorchRL 0.14.1 while torch 2.13 traces them.
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.filterwarnings("ignore:Using lock_.. inside a compiled:UserWarning")
@pytest.mark.parametrize("name", [*MODES, "idm"])
def test_compiled_loss_equals_eager_without_graph_breaks(
    make_networks, make_batch, name
) -> None:
    networks, batch = make_networks(), make_batch(10)
    if name == "idm":
        loss = InverseDynamicsLoss(networks.inverse_dynamics)
    else:
        loss = build(name, networks)
    eager = losses_and_gradients(loss, loss.parameters(), batch)
    torch.compiler.reset()
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    found = losses_and_gradients(compiled, loss.parameters(), batch)
    for ours, theirs in zip(found, eager, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def rows_scored(mode: str, networks, batch, **kwargs) -> float:
    """How many actions all critics together score for one row of the batch."""
    scored = []
    for critic in networks.critics:
        critic.module.register_forward_pre_hook(
            lambda _, inputs: scored.append(inputs[0].shape[:-1].numel())
        )
    build(mode, networks, deactivate_vmap=True, **kwargs)(batch)
    return sum(scored) / batch.numel()


# For each critic: the data's action, the policy's own action at every state of D_tot,
# the next action, and with K = 3 the proposals: 3K at the state of the data, or those
# of policy and model (and uniform ones) at both states.
@pytest.mark.parametrize(
    ("mode", "rows"),
    [
        ("cql", 1 + 1 + 1 + 9),
        ("osr", 1 + 2 + 1 + 9),
        ("osrv", 1 + 2 + 1 + 2 * 6),
        ("osrv-logsumexp", 1 + 2 + 1 + 2 * 9),
    ],
)
@pytest.mark.parametrize("count", [1, 2])
def test_critics_score_no_more_rows_than_the_equations_ask(
    make_networks, make_batch, mode, rows, count
) -> None:
    networks, batch = make_networks(num_critics=count), make_batch(10)
    assert rows_scored(mode, networks, batch) == count * rows


ENSEMBLE = {"min_q_weight": 0.0, "deterministic_backup": False}


# What the documentation says that a row costs; K = 10 of CQL is its default.
@pytest.mark.parametrize(
    ("mode", "critics", "options", "rows"),
    [
        ("cql", 2, {}, 66),
        ("osr", 2, {}, 68),
        ("osr", 2, {"actor_states": "clean"}, 66),
        ("osr", 2, {"max_q_backup": True}, 86),
        ("osrv", 2, {}, 16),
        ("cql", 10, ENSEMBLE, 30),
        ("cql", 10, ENSEMBLE | {"diversity_weight": 1.0}, 40),
        ("osr", 10, ENSEMBLE | {"actor_states": "clean"}, 30),
        ("osr", 10, ENSEMBLE, 40),
    ],
)
def test_rows_scored_with_the_defaults(
    make_networks, make_batch, mode, critics, options, rows
) -> None:
    default = inspect.signature(OSRVLoss if mode == "osrv" else OSRLoss)
    number = default.parameters["num_random"].default
    networks, batch = make_networks(num_critics=critics), make_batch(10)
    assert rows_scored(mode, networks, batch, num_random=number, **options) == rows
