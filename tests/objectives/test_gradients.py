"""Where each loss sends its gradient, and what must never reach one."""

from __future__ import annotations

import math

import pytest
import torch

REDUCTIONS = ["mean", "sum", "none"]
OUTPUT_BIAS = "qvalue_network_params.module.2.bias"


def gradients(loss, value: torch.Tensor) -> dict[str, torch.Tensor | None]:
    names, parameters = zip(*loss.named_parameters(), strict=True)
    found = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    return dict(zip(names, found, strict=True))


@pytest.mark.losses
@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_each_term_reaches_its_own_parameters_only(
    family, family_batch, terms, name, reduction
) -> None:
    loss, member = family(name, reduction=reduction), family[name]
    groups = member.groups.copy()
    for key in member.weights.get("recovery_weight", []):
        groups["recovery"] = groups[key]
    # All of this loss is the recovery term.
    groups.pop("loss_recovery", None)
    found = terms(name, loss, family_batch(name, 10))
    for key, group in groups.items():
        # A constant added to Q is in both halves of a gap and cancels.
        is_gap = key in ("loss_cql", "recovery") and not member.discrete
        for parameter, gradient in gradients(loss, found[key].sum()).items():
            if parameter.split(".")[0] != group:
                assert gradient is None, (key, parameter)
            elif is_gap and parameter == OUTPUT_BIAS:
                assert gradient.abs().max() < 1e-12, key
            else:
                assert gradient.abs().max() > 1e-9, (key, parameter)


@pytest.mark.losses
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


@pytest.mark.losses(having="temperature")
def test_fixed_alpha_is_no_parameter(family, family_batch, name) -> None:
    loss = family(name, fixed_alpha=True, alpha_init=0.25)
    assert "log_alpha" not in dict(loss.named_parameters())
    out = loss(family_batch(name, 10))
    assert not out["loss_alpha"].requires_grad
    # float32: the constructor takes the logarithm before .double().
    assert out["alpha"].item() == pytest.approx(0.25, rel=1e-6)


def spoil(batch, flag: torch.Tensor, value: float):
    batch = batch.clone()
    batch["next", "observation"][flag.squeeze(-1)] = value
    return batch


@pytest.mark.losses
@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_next_state_of_ended_rows_changes_no_bit_of_any_loss(
    family, family_batch, record, assert_same_bits, name, garbage
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    # A row cut by a time limit has a next state for the critics, and for them alone.
    flag = "terminated" if family.has(name, "critics") else "done"
    spoiled = spoil(batch, batch["next", flag], garbage)
    assert_same_bits(record(loss, spoiled), record(loss, batch))


# A finite state, which the policy's only pass over all states sees, too.
@pytest.mark.losses("osr", "official", "osr-10", "discrete", "osrv", "osrv-logsumexp")
def test_next_state_of_cut_rows_is_bootstrapped_from_but_never_recovered_to(
    family, family_batch, seeded, record, assert_same_bits, name
) -> None:
    loss, batch = family(name), family_batch(name, 10)
    at_the_limit = batch["next", "done"] & ~batch["next", "terminated"]
    spoiled = spoil(batch, at_the_limit, 1e6)
    for key in ("loss_qvalue", "target_value"):
        assert seeded(loss, spoiled)[key] != seeded(loss, batch)[key]
    # Without discount there is no bootstrap, but still the recovery term.
    loss.make_value_estimator(gamma=0.0)
    (key,) = family[name].weights["recovery_weight"]
    assert_same_bits(record(loss, spoiled, [key]), record(loss, batch, [key]))
    metric = family[name].recovery_metric
    for garbage in (1e6, math.nan):
        spoiled = spoil(batch, at_the_limit, garbage)
        assert torch.equal(seeded(loss, spoiled)[metric], seeded(loss, batch)[metric])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("idm", {"states": "clean"}),
        ("recovery", {"recovery_states": "clean"}),
        ("recovery", {"recovery_states": "perturbed"}),
        ("recovery-delta", {"recovery_states": "clean"}),
        ("recovery-plain", {"recovery_states": "perturbed"}),
    ],
)
@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_next_state_of_done_rows_counts_on_neither_half_of_the_states(
    family, family_batch, record, assert_same_bits, name, options, garbage
) -> None:
    loss, batch = family(name, **options), family_batch(name, 10)
    spoiled = spoil(batch, batch["next", "done"], garbage)
    assert_same_bits(record(loss, spoiled), record(loss, batch))
