"""Where each loss sends its gradient, and what must never reach one."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss

ACTOR, CRITICS = "actor_network_params", "qvalue_network_params"
SHARED = {"loss_actor": ACTOR, "loss_qvalue": CRITICS, "loss_alpha": "log_alpha"}
GROUPS = {
    "osr": SHARED | {"loss_cql": CRITICS, "loss_recovery": ACTOR},
    "cql": SHARED | {"loss_cql": CRITICS},
    "osrv": SHARED | {"loss_recovery": CRITICS},
    "osrv-logsumexp": SHARED | {"loss_recovery": CRITICS},
}
# A constant added to Q is in both halves of a gap and cancels.
OUTPUT_BIAS = f"{CRITICS}.module.2.bias"
MODES = list(GROUPS)
RECOVERING = [mode for mode in MODES if mode != "cql"]
CASES = [(mode, key) for mode, groups in GROUPS.items() for key in groups]


def make_loss(networks, mode: str, **kwargs) -> OSRLoss | OSRVLoss:
    loss_class = OSRVLoss if mode.startswith("osrv") else OSRLoss
    if mode == "osrv-logsumexp":
        kwargs["policy_values"] = "logsumexp"
    loss = loss_class(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        recovery_weight=0.0 if mode == "cql" else 0.5,
        num_random=3,
        **kwargs,
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


def gradients(loss, value: torch.Tensor) -> dict[str, torch.Tensor | None]:
    names, parameters = zip(*loss.named_parameters(), strict=True)
    found = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize(("mode", "key"), CASES)
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_each_loss_reaches_its_own_parameters_only(
    make_networks, make_batch, mode, key, reduction
) -> None:
    loss = make_loss(
        make_networks(), mode, reduction=reduction, scalar_output_mode="exclude"
    )
    value = loss(make_batch(10))[key].sum()
    for name, gradient in gradients(loss, value).items():
        if name.startswith(GROUPS[mode][key]):
            assert gradient is not None, name
            # A constant added to Q is in both halves of a gap, and cancels.
            if key in ("loss_cql", "loss_recovery") and name == OUTPUT_BIAS:
                assert gradient.abs().max() < 1e-12, name
            else:
                assert gradient.abs().max() > 1e-9, name
        else:
            assert gradient is None, name


@pytest.mark.parametrize("mode", MODES)
def test_nothing_else_can_be_trained(make_networks, make_batch, mode) -> None:
    networks = make_networks()
    loss = make_loss(networks, mode)
    groups = {name.split(".")[0] for name, _ in loss.named_parameters()}
    assert groups == {ACTOR, CRITICS, "log_alpha"}
    sum(v for k, v in loss(make_batch(10)).items() if k in GROUPS[mode]).backward()
    assert all(p.grad is None for p in networks.inverse_dynamics.parameters())
    assert not any(buffer.requires_grad for buffer in loss.buffers())


def test_fixed_alpha_is_no_parameter(make_networks, make_batch) -> None:
    loss = make_loss(make_networks(), "osr", fixed_alpha=True, alpha_init=0.25)
    assert "log_alpha" not in dict(loss.named_parameters())
    out = loss(make_batch(10))
    assert not out["loss_alpha"].requires_grad
    # float32: the constructor takes the logarithm before .double().
    assert out["alpha"].item() == pytest.approx(0.25, rel=1e-6)


def losses_and_gradients(loss, batch, keys) -> list[torch.Tensor | None]:
    torch.manual_seed(3)
    out = loss(batch)
    record: list[torch.Tensor | None] = []
    for key in keys:
        record += [out[key].detach(), *gradients(loss, out[key]).values()]
    return record


def spoil(batch, flag: torch.Tensor, value: float):
    batch = batch.clone()
    batch["next", "observation"][flag.squeeze(-1)] = value
    return batch


def assert_same_bits(got, wanted) -> None:
    for ours, theirs in zip(got, wanted, strict=True):
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.equal(ours, theirs)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e6])
def test_next_state_of_terminated_rows_changes_no_bit_of_any_loss(
    make_networks, make_batch, mode, garbage
) -> None:
    loss, batch = make_loss(make_networks(), mode), make_batch(10)
    keys = GROUPS[mode]
    wanted = losses_and_gradients(loss, batch, keys)
    spoiled = spoil(batch, batch["next", "terminated"], garbage)
    assert_same_bits(losses_and_gradients(loss, spoiled, keys), wanted)


# Finite for OSRLoss: its gradient passes through the actor, which does see s' here.
@pytest.mark.parametrize(
    ("mode", "garbage"),
    [(mode, 1e6) for mode in RECOVERING]
    + [(mode, math.nan) for mode in RECOVERING if mode != "osr"],
)
def test_next_state_of_cut_rows_is_bootstrapped_from_but_never_recovered_to(
    make_networks, make_batch, mode, garbage
) -> None:
    loss, batch = make_loss(make_networks(), mode), make_batch(10)
    cut = batch["next", "done"] & ~batch["next", "terminated"]
    spoiled = spoil(batch, cut, garbage)
    recovery, value = (
        losses_and_gradients(loss, batch, [key])
        for key in ("loss_recovery", "loss_qvalue")
    )
    assert_same_bits(losses_and_gradients(loss, spoiled, ["loss_recovery"]), recovery)
    assert not torch.equal(
        losses_and_gradients(loss, spoiled, ["loss_qvalue"])[0], value[0]
    )


@pytest.mark.parametrize("states", ["both", "clean"])
@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_next_state_of_done_rows_changes_no_bit_of_the_model_loss(
    make_networks, make_batch, states, garbage
) -> None:
    loss = InverseDynamicsLoss(make_networks().inverse_dynamics, states=states)
    batch = make_batch(10)
    keys = ["loss_inverse_dynamics"]
    wanted = losses_and_gradients(loss, batch, keys)
    spoiled = spoil(batch, batch["next", "done"], garbage)
    assert_same_bits(losses_and_gradients(loss, spoiled, keys), wanted)


@pytest.mark.parametrize("mode", RECOVERING)
def test_a_batch_without_any_transition_gives_no_recovery_loss(
    make_networks, make_batch, mode
) -> None:
    networks, batch = make_networks(), make_batch(10)
    batch["next", "done"] = torch.ones_like(batch["next", "done"])
    loss = make_loss(networks, mode)
    assert loss(batch)["loss_recovery"].item() == 0.0
    model_loss = InverseDynamicsLoss(make_networks().inverse_dynamics)
    assert model_loss(batch)["loss_inverse_dynamics"].item() == 0.0


def test_the_lowest_critic_alone_decides_actor_and_target(
    make_networks, make_batch
) -> None:
    # A third critic that is lower everywhere decides actor and target alone.
    networks = make_networks(num_critics=3)
    networks.critics[2].module[-1].bias.data -= 100.0
    loss, batch = make_loss(networks, "cql"), make_batch(10)
    alone = make_networks(num_critics=3)
    alone.critics = [networks.critics[2]]
    single = make_loss(alone, "cql")
    torch.manual_seed(3)
    wanted = single(batch)
    torch.manual_seed(3)
    out = loss(batch)
    for key in ("loss_actor", "target_value"):
        torch.testing.assert_close(out[key], wanted[key], rtol=1e-12, atol=1e-12)
