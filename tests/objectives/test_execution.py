"""The same numbers with and without vmap and torch.compile, and how many rows."""

from __future__ import annotations

import inspect

import pytest
import torch
from torch._dynamo.exc import InternalTorchDynamoError

# One loss for each path that is traced; tracing takes seconds. With ReLU critics: osr,
# and in cql-options all of CQL that is off by default. Critics that are vmapped: with
# CQL's term in noisy-cloning, in osrv and in edac.
TRACED = (
    "osr", "cql-options", "noisy-cloning", "osrv", "edac", "td3bc", "discrete",
    "recovery", "recovery-delta", "idm", "cvae",
)  # fmt: skip


@pytest.mark.losses(having="critics")
@pytest.mark.parametrize("count", [1, 3])
def test_a_loop_over_critics_equals_vmap(
    family, family_batch, record, assert_same, name, count
) -> None:
    count = max(count, 2) if name in ("edac", "rorl") else count
    looped, mapped = (
        record(
            family(
                name,
                family.networks(name, num_critics=count),
                deactivate_vmap=deactivate,
            ),
            family_batch(name, 10),
        )
        for deactivate in (True, False)
    )
    assert_same(looped, mapped)


# torch 2.13, tensordict 0.14.3 and TorchRL 0.14.1 warn of each other while they are
# traced, and not at every time of the same things.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.losses(*TRACED)
def test_compiled_loss_equals_eager_without_graph_breaks(
    family, family_batch, seeded, record, assert_same, name
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    eager, metrics = record(loss, batch), seeded(loss, batch)
    torch.compiler.reset()
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    try:
        traced = record(compiled, batch)
    except InternalTorchDynamoError as error:
        # Its message quotes the line of ours; hundreds of frames of the tracer do not.
        pytest.fail(str(error), pytrace=False)
    assert_same(traced, eager)
    out = seeded(compiled, batch)
    keys = family[name].out_keys
    assert_same([out[key] for key in keys], [metrics[key] for key in keys])


def rows_scored(family, name: str, batch, *, critics: int = 2, **options) -> float:
    """How many rows all critics together score for one row of the batch.

    A row is a state and an action, or a state where a critic values all actions.
    """
    networks, scored = family.networks(name, num_critics=critics), []
    for critic in networks.critics:
        critic.module.register_forward_pre_hook(
            lambda _, inputs: scored.append(inputs[0].shape[:-1].numel())
        )
    loss = family(name, networks, deactivate_vmap=True, **options)
    out = loss(batch)
    sum(out[key] for key in loss.out_keys if key.startswith("loss_")).backward()
    return sum(scored) / batch.numel()


# For each critic: the data's action, the policy's own action at every state of D_tot,
# the next action, and with K = 3 the proposals: 3K at the state of the data, or those
# of policy and model (and uniform ones) at both states.
@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("cql", 1 + 1 + 1 + 9),
        ("osr", 1 + 2 + 1 + 9),
        ("osrv", 1 + 2 + 1 + 2 * 6),
        ("osrv-logsumexp", 1 + 2 + 1 + 2 * 9),
        ("td3bc", 1 + 1 + 1),
        ("discrete", 1 + 2 + 1),
        ("discrete-cql", 1 + 1 + 1),
    ],
)
@pytest.mark.parametrize("count", [1, 2])
def test_critics_score_no_more_rows_than_the_equations_ask(
    family, family_batch, name, rows, count
) -> None:
    batch = family_batch(name, 10)
    assert rows_scored(family, name, batch, critics=count) == count * rows


ENSEMBLE = {"min_q_weight": 0.0, "deterministic_backup": False}


# What the documentation says that a row costs; K is the loss's default.
@pytest.mark.parametrize(
    ("label", "name", "critics", "options", "rows"),
    [
        ("CQL(H)", "cql", 2, {}, 66),
        ("OSR", "osr", 2, {}, 68),
        ("OSR, official variant", "official", 2, {}, 66),
        ("CQL(H) and cloning", "cloning", 2, {}, 66),
        ("CQL(H) and noisy cloning", "noisy-cloning", 2, {}, 68),
        (None, "osr", 2, {"max_q_backup": True}, 86),
        ("OSR-v", "osrv", 2, {}, 16),
        ("SAC-N", "cql", 10, ENSEMBLE, 30),
        ("EDAC", "edac", 10, {}, 40),
        ("OSR-10", "osr", 10, ENSEMBLE, 40),
        (None, "osr", 10, ENSEMBLE | {"actor_states": "clean"}, 30),
        ("TD3+BC", "td3bc", 2, {}, 6),
        ("ReBRAC", "rebrac", 2, {}, 6),
        ("RORL", "rorl", 10, {"num_samples": 20}, 430),
        ("SCAS", "scas", 4, {}, 16),
        ("SDC", "sdc", 2, {"num_random": 10}, 66),
        ("Discrete OSR", "discrete", 2, {}, 8),
        ("Discrete CQL(H)", "discrete-cql", 2, {}, 6),
    ],
)
def test_rows_scored_with_the_defaults(
    family, family_batch, record_property, label, name, critics, options, rows
) -> None:
    defaults = inspect.signature(family[name].loss_class).parameters
    if "num_random" in defaults:
        options = {"num_random": defaults["num_random"].default} | options
    batch = family_batch(name, 10)
    scored = rows_scored(family, name, batch, critics=critics, **options)
    if label:
        record_property("rows", (label, scored))
    assert scored == rows
