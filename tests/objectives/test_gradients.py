"""Where each loss sends its gradient, and what must never reach one."""

from __future__ import annotations

import math

import pytest
import torch

REDUCTIONS = ["mean", "sum", "none"]
OF_TRANSITIONS = ("loss_recovery", "loss_inverse_dynamics")
# A constant added to Q is in both halves of a gap and cancels; no gradient by the
# action knows of it.
CANCELS = ("loss_cql", "loss_recovery", "loss_diversity")
OUTPUT_BIAS = "qvalue_network_params.module.2.bias"


def gradients(loss, value: torch.Tensor) -> dict[str, torch.Tensor | None]:
    names, parameters = zip(*loss.named_parameters(), strict=True)
    found = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_each_loss_reaches_its_own_parameters_only(
    family, family_batch, name, reduction
) -> None:
    loss, member = family(name, reduction=reduction), family[name]
    out = loss(family_batch(name, 10))
    for key, group in member.groups.items():
        for parameter, gradient in gradients(loss, out[key].sum()).items():
            if parameter.split(".")[0] != group:
                assert gradient is None, (key, parameter)
            elif key in CANCELS and parameter == OUTPUT_BIAS and not member.discrete:
                assert gradient is None or gradient.abs().max() < 1e-12, key
            else:
                assert gradient.abs().max() > 1e-9, (key, parameter)


def test_nothing_else_can_be_trained(family, family_batch, name) -> None:
    networks, member = family.networks(name), family[name]
    loss = family(name, networks)
    groups = {key.split(".")[0] for key, _ in loss.named_parameters()}
    assert groups == set(member.groups.values())
    out = loss(family_batch(name, 10))
    assert not any(out[key].requires_grad for key in member.metrics)
    sum(out[key] for key in member.groups).backward()
    assert all(parameter.grad is not None for parameter in loss.parameters())
    if "inverse_dynamics_network_params" not in groups:
        parameters = networks.inverse_dynamics.parameters()
        assert all(parameter.grad is None for parameter in parameters)
    assert not any(buffer.requires_grad for buffer in loss.buffers())


def test_fixed_alpha_is_no_parameter(family, family_batch, critic_loss) -> None:
    loss = family(critic_loss, fixed_alpha=True, alpha_init=0.25)
    assert "log_alpha" not in dict(loss.named_parameters())
    out = loss(family_batch(critic_loss, 10))
    assert not out["loss_alpha"].requires_grad
    # float32: the constructor takes the logarithm before .double().
    assert out["alpha"].item() == pytest.approx(0.25, rel=1e-6)


def spoil(batch, flag: torch.Tensor, value: float):
    batch = batch.clone()
    batch["next", "observation"][flag.squeeze(-1)] = value
    return batch


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e6])
def test_next_state_of_ended_rows_changes_no_bit_of_any_loss(
    family, family_batch, record, assert_same_bits, name, garbage
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    # A row cut by a time limit has a next state for the critics, and for them alone.
    flag = "terminated" if family[name].has_critics else "done"
    spoiled = spoil(batch, batch["next", flag], garbage)
    assert_same_bits(record(loss, spoiled), record(loss, batch))


# Finite where the gradient passes through the actor, which does see s' here.
@pytest.mark.parametrize(
    ("cut", "garbage"),
    [
        ("osr", 1e6),
        ("official", 1e6),
        ("osr-10", 1e6),
        ("adversarial", 1e6),
        ("discrete", 1e6),
        ("osrv", 1e6),
        ("osrv", math.nan),
        ("osrv-logsumexp", math.nan),
    ],
)
def test_next_state_of_cut_rows_is_bootstrapped_from_but_never_recovered_to(
    family, family_batch, seeded, record, assert_same_bits, cut, garbage
) -> None:
    loss, batch = family(cut), family_batch(cut, 10)
    at_the_limit = batch["next", "done"] & ~batch["next", "terminated"]
    spoiled = spoil(batch, at_the_limit, garbage)
    keys = ["loss_recovery"]
    assert_same_bits(record(loss, spoiled, keys), record(loss, batch, keys))
    for key in ("loss_qvalue", "target_value"):
        assert seeded(loss, spoiled)[key] != seeded(loss, batch)[key]


@pytest.mark.parametrize(
    ("model", "states"),
    [
        ("idm", "clean"),
        ("recovery", "clean"),
        ("recovery", "perturbed"),
        ("recovery-delta", "clean"),
        ("recovery-plain", "perturbed"),
    ],
)
@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_next_state_of_done_rows_counts_on_neither_half_of_the_states(
    family, family_batch, record, assert_same_bits, model, states, garbage
) -> None:
    loss, batch = family(model, states=states), family_batch(model, 10)
    spoiled = spoil(batch, batch["next", "done"], garbage)
    assert_same_bits(record(loss, spoiled), record(loss, batch))


def test_a_batch_without_any_transition_gives_no_loss_of_transitions(
    family, family_batch, name
) -> None:
    batch = family_batch(name, 10)
    batch["next", "done"][:] = True
    out = family(name)(batch)
    for key in family[name].groups:
        assert (key not in OF_TRANSITIONS) or out[key].item() == 0.0, key


@pytest.mark.parametrize("pessimist", ["osr", "cql", "cql-options", "osrv", "discrete"])
def test_the_lowest_critic_alone_decides_actor_and_target(
    family, family_batch, seeded, pessimist
) -> None:
    # A third critic that is lower everywhere decides actor and target alone.
    networks, alone = (family.networks(pessimist, num_critics=3) for _ in range(2))
    for each in (networks, alone):
        each.critics[2].module[-1].bias.data -= 100.0
    alone.critics = alone.critics[2:]
    batch = family_batch(pessimist, 10)
    out, wanted = (seeded(family(pessimist, each), batch) for each in (networks, alone))
    for key in ("loss_actor", "target_value"):
        torch.testing.assert_close(out[key], wanted[key], rtol=1e-12, atol=1e-12)
