"""DiscreteOSRLoss keeps the contract of OSRLoss: gradients, masks, keys, state."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torch.distributions import OneHotCategorical as TorchOneHotCategorical
from torchrl.objectives import SoftUpdate

from torchrl_osr import DiscreteOSRLoss

ACTOR, CRITICS = "actor_network_params", "qvalue_network_params"
GROUPS = {
    "loss_actor": ACTOR,
    "loss_alpha": "log_alpha",
    "loss_qvalue": CRITICS,
    "loss_cql": CRITICS,
    "loss_recovery": ACTOR,
}
METRICS = ["alpha", "entropy", "pred_value", "target_value", "recovery_kl"]
TRANSITION = ["observation", "action", ("next", "observation")]
TRANSITION += [("next", key) for key in ("reward", "done", "terminated")]


def build(networks, **kwargs) -> DiscreteOSRLoss:
    """A float64 loss whose target networks somebody moves."""
    loss = DiscreteOSRLoss(
        networks.actor,
        networks.critics,
        networks.inverse_dynamics,
        **({"alpha_init": 0.5} | kwargs),
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


def gradients(loss, value: torch.Tensor) -> dict[str, torch.Tensor | None]:
    names, parameters = zip(*loss.named_parameters(), strict=True)
    found = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    return dict(zip(names, found, strict=True))


def record(loss, batch, keys=tuple(GROUPS)) -> list[torch.Tensor]:
    """Losses and what of their gradients there is."""
    out = loss(batch)
    found: list[torch.Tensor] = []
    for key in keys:
        each = gradients(loss, out[key].sum()).values()
        found += [out[key].detach(), *(value for value in each if value is not None)]
    return found


def assert_same(got, wanted, tolerance: float = 1e-12) -> None:
    for ours, theirs in zip(got, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)


def assert_same_bits(got, wanted) -> None:
    assert all(map(torch.equal, got, wanted))
    assert len(got) == len(wanted)


@pytest.mark.parametrize("key", GROUPS)
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_each_loss_reaches_its_own_parameters_only(
    make_discrete_networks, make_discrete_batch, key, reduction
) -> None:
    loss = build(
        make_discrete_networks(), reduction=reduction, scalar_output_mode="exclude"
    )
    value = loss(make_discrete_batch(10))[key].sum()
    for name, gradient in gradients(loss, value).items():
        if name.startswith(GROUPS[key]):
            assert gradient.abs().max() > 1e-9, name
        else:
            assert gradient is None, name


def test_nothing_else_can_be_trained(
    make_discrete_networks, make_discrete_batch
) -> None:
    networks = make_discrete_networks()
    loss, batch = build(networks), make_discrete_batch(10)
    groups = {name.split(".")[0] for name, _ in loss.named_parameters()}
    assert groups == {ACTOR, CRITICS, "log_alpha"}
    sum(v for k, v in loss(batch).items() if k in GROUPS).backward()
    assert all(p.grad is None for p in networks.inverse_dynamics.parameters())
    fixed = build(make_discrete_networks(), fixed_alpha=True)
    assert "log_alpha" not in dict(fixed.named_parameters())
    assert not fixed(batch)["loss_alpha"].requires_grad


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e6])
def test_next_state_of_ended_rows_changes_no_bit(
    make_discrete_networks, make_discrete_batch, garbage
) -> None:
    loss, batch = build(make_discrete_networks()), make_discrete_batch(10)
    wanted = record(loss, batch)
    terminated, done = (
        batch["next", key].squeeze(-1) for key in ("terminated", "done")
    )
    spoiled = batch.clone()
    spoiled["next", "observation"][terminated] = garbage
    assert_same_bits(record(loss, spoiled), wanted)
    # Rows cut by a time limit are bootstrapped from, but never recovered to.
    spoiled["next", "observation"][done] = 1e6
    keys = ["loss_recovery"]
    assert_same_bits(record(loss, spoiled, keys), record(loss, batch, keys))
    assert loss(spoiled)["target_value"] != loss(batch)["target_value"]


def test_a_batch_without_any_transition_gives_no_recovery_loss(
    make_discrete_networks, make_discrete_batch
) -> None:
    loss, batch = build(make_discrete_networks()), make_discrete_batch(10)
    batch["next", "done"][:] = True
    assert loss(batch)["loss_recovery"].item() == 0.0


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_padding_changes_neither_losses_nor_gradients(
    make_discrete_networks, make_discrete_batch, reduction
) -> None:
    mode = "exclude" if reduction == "none" else None
    loss = build(make_discrete_networks(), reduction=reduction, scalar_output_mode=mode)
    batch = make_discrete_batch(2, 5)
    batch["collector", "mask"] = torch.ones(2, 5, 1, dtype=torch.bool)
    batch["collector", "mask"][:, 3:] = False
    spoiled = batch.clone()
    for key in ("observation", ("next", "observation"), ("perturbed", "observation")):
        spoiled[key][:, 3:] = 30.0
    spoiled["next", "reward"][:, 3:] = -1e6
    assert_same(record(loss, spoiled), record(loss, batch))


@pytest.mark.parametrize("size", [(10,), (2, 5)])
def test_reductions_agree(make_discrete_networks, make_discrete_batch, size) -> None:
    batch, out = make_discrete_batch(*size), {}
    for reduction in ("mean", "sum", "none"):
        mode = "exclude" if reduction == "none" else None
        loss = build(
            make_discrete_networks(), reduction=reduction, scalar_output_mode=mode
        )
        out[reduction] = loss(batch)
        expected = [*GROUPS] if mode else [*GROUPS, *METRICS]
        assert list(out[reduction].keys()) == loss.out_keys == expected
    done = batch["next", "done"].squeeze(-1)
    for key in GROUPS:
        each = out["none"][key]
        assert each.shape == size
        rows = (~done).sum() if key == "loss_recovery" else done.numel()
        torch.testing.assert_close(out["sum"][key], each.sum())
        torch.testing.assert_close(out["mean"][key], each.sum() / rows)


def test_weights_of_zero_leave_the_terms_out(
    make_discrete_networks, make_discrete_batch
) -> None:
    networks, batch = make_discrete_networks(), make_discrete_batch(10, twin=False)
    networks.inverse_dynamics = None
    loss = build(networks, recovery_weight=0.0)
    assert loss.in_keys == TRANSITION
    assert list(loss(batch).keys()) == [*list(GROUPS)[:-1], *METRICS[:-1]]
    loss = build(make_discrete_networks(), min_q_weight=0.0)
    assert loss.in_keys == [*TRANSITION, ("perturbed", "observation")]
    expected = [key for key in GROUPS if key != "loss_cql"] + METRICS
    assert list(loss(make_discrete_batch(10)).keys()) == loss.out_keys == expected


@pytest.mark.parametrize("weight", ["recovery_weight", "min_q_weight"])
def test_weights_can_be_scheduled_in_place(
    make_discrete_networks, make_discrete_batch, weight
) -> None:
    loss, batch = build(make_discrete_networks()), make_discrete_batch(10)
    key = {"recovery_weight": "loss_recovery", "min_q_weight": "loss_cql"}[weight]
    before, buffer = loss(batch), getattr(loss, weight)
    old = buffer.item()
    setattr(loss, weight, 2 * old)
    after = loss(batch)
    assert getattr(loss, weight) is buffer
    for name in GROUPS:
        factor = 2 if name == key else 1
        torch.testing.assert_close(after[name], factor * before[name])


def test_nested_and_renamed_keys_give_the_same_numbers(
    make_discrete_networks, make_discrete_batch
) -> None:
    batch = make_discrete_batch(10)
    wanted = build(make_discrete_networks())(batch)
    state, action = ("agent", "state"), ("agent", "choice")
    networks = make_discrete_networks(observation=state, action=action)
    for critic in networks.critics:
        critic.out_keys = [("agent", "values")]
    loss = build(networks)
    names = {"action": action, "action_value": ("agent", "values")}
    names |= {"perturbed": "noisy", "terminated": "over", "priority": "error"}
    loss.set_keys(**names)
    renamed = TensorDict({}, [10])
    renamed[action] = batch["action"]
    renamed[state] = batch["observation"]
    renamed["noisy", *state] = batch["perturbed", "observation"]
    renamed["next", *state] = batch["next", "observation"]
    for old, new in {"reward": "reward", "done": "done", "terminated": "over"}.items():
        renamed["next", new] = batch["next", old]
    out = loss(renamed)
    assert_same([out[key] for key in loss.out_keys], [wanted[k] for k in loss.out_keys])
    assert torch.equal(renamed["error"], batch["td_error"])
    names = [key if isinstance(key, str) else "_".join(key) for key in loss.in_keys]
    inputs = dict(zip(names, map(renamed.get, loss.in_keys), strict=True))
    assert_same(loss(**inputs), [wanted[key] for key in loss.out_keys])


FORMS = {
    "int64 [B]": lambda index: index,
    "int32 [B, 1]": lambda index: index.int().unsqueeze(-1),
    "uint8 [B]": lambda index: index.byte(),
}


@pytest.mark.parametrize("form", FORMS)
def test_indices_and_one_hot_vectors_give_the_same_numbers(
    make_discrete_networks, make_discrete_batch, form
) -> None:
    batch = make_discrete_batch(2, 5)
    wanted = record(build(make_discrete_networks()), batch)
    networks = make_discrete_networks(distribution_class=Categorical)
    batch["action"] = FORMS[form](batch["action"].argmax(-1))
    assert_same_bits(record(build(networks), batch), wanted)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64, torch.float32])
@pytest.mark.parametrize("torchs", [False, True], ids=["torchrl", "torch"])
def test_one_hot_vectors_may_be_of_any_type(
    make_discrete_networks, make_discrete_batch, dtype, torchs
) -> None:
    batch = make_discrete_batch(10)
    wanted = record(build(make_discrete_networks()), batch)
    kwargs = {"distribution_class": TorchOneHotCategorical} if torchs else {}
    batch["action"] = batch["action"].to(dtype)
    assert_same_bits(record(build(make_discrete_networks(**kwargs)), batch), wanted)


def test_an_action_that_is_never_taken_leaves_all_finite(
    make_discrete_networks, make_discrete_batch
) -> None:
    networks, batch = make_discrete_networks(), make_discrete_batch(10)
    for network in (networks.actor, networks.inverse_dynamics):
        network[0].module[-1].bias.data[2] = -math.inf
    loss = build(networks)
    for value in record(loss, batch):
        # The bias itself cannot be moved by a step, but must not spoil the others.
        assert value.isfinite().all()


def test_state_dict_and_copies_restore_every_number(
    make_discrete_networks, make_discrete_batch
) -> None:
    batch, loss = make_discrete_batch(10), build(make_discrete_networks())
    for parameter in loss.parameters():
        parameter.data.add_(0.1)
    loss.min_q_weight = 1.25
    before = loss.state_dict()
    wanted = record(loss, batch)
    fresh = build(make_discrete_networks(seed=9))
    fresh.load_state_dict(before)
    assert_same_bits(record(fresh, batch), wanted)
    assert_same_bits(record(copy.deepcopy(loss), batch), wanted)
    assert loss.state_dict().keys() == before.keys()


def test_soft_update_moves_targets_a_little(make_discrete_networks) -> None:
    loss = build(make_discrete_networks())
    updater = SoftUpdate(loss, tau=0.25)
    old = [p.clone() for p in loss.target_qvalue_network_params.values(True, True)]
    for parameter in loss.qvalue_network_params.values(True, True):
        parameter.data.add_(1.0)
    updater.step()
    new = loss.target_qvalue_network_params.values(True, True)
    for before, after in zip(old, new, strict=True):
        torch.testing.assert_close(after, before + 0.25)


@pytest.mark.parametrize("count", [1, 3])
def test_a_loop_over_critics_equals_vmap(
    make_discrete_networks, make_discrete_batch, count
) -> None:
    mapped, looped = (
        record(
            build(make_discrete_networks(num_critics=count), deactivate_vmap=looped),
            make_discrete_batch(10),
        )
        for looped in (False, True)
    )
    assert_same(looped, mapped)


# Raised inside tensordict 0.14.3 and TorchRL 0.14.1 while torch 2.13 traces them.
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.filterwarnings("ignore:Using lock_.. inside a compiled:UserWarning")
@pytest.mark.parametrize("one_hot", [True, False])
def test_compiled_loss_equals_eager_without_graph_breaks(
    make_discrete_networks, make_discrete_batch, one_hot
) -> None:
    networks, batch = make_discrete_networks(), make_discrete_batch(10)
    if not one_hot:
        networks = make_discrete_networks(distribution_class=Categorical)
        batch["action"] = batch["action"].argmax(-1)
    loss = build(networks)
    wanted = loss(batch)
    torch.compiler.reset()
    out = torch.compile(loss, backend="eager", fullgraph=True)(batch)
    assert_same([out[key] for key in wanted.keys()], wanted.values())  # noqa: SIM118
    parameters = list(loss.parameters())
    both = [
        torch.autograd.grad(sum(each[key] for key in GROUPS), parameters)
        for each in (out, wanted)
    ]
    assert_same(*both)
