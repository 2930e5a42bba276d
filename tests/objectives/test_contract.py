"""TorchRL's conventions, one test each for every loss of the package."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, OSRVLoss

NAMES = ["osr", "cql", "osrv", "idm"]
MODES = ["osr", "cql", "osrv"]
REDUCTIONS = ["mean", "sum", "none"]
CRITIC_LOSSES = ["loss_actor", "loss_alpha", "loss_qvalue", "loss_cql"]
METRICS = ["alpha", "entropy", "pred_value", "target_value"]
LOSS_KEYS = {
    "osr": [*CRITIC_LOSSES, "loss_recovery"],
    "cql": CRITIC_LOSSES,
    "osrv": [*CRITIC_LOSSES[:-1], "loss_recovery"],
    "idm": ["loss_inverse_dynamics"],
}
OUT_KEYS = {
    "osr": [*LOSS_KEYS["osr"], *METRICS, "recovery_kl"],
    "cql": [*LOSS_KEYS["cql"], *METRICS],
    "osrv": [*LOSS_KEYS["osrv"], *METRICS, "recovery_gap"],
    "idm": LOSS_KEYS["idm"],
}
NEXT = ("next", "observation")
TRANSITION = ["observation", "action", NEXT]
TRANSITION += [("next", key) for key in ("reward", "done", "terminated")]
TWIN = ("perturbed", "observation")
IN_KEYS = {
    "osr": [*TRANSITION, TWIN],
    "cql": TRANSITION,
    "osrv": [*TRANSITION, TWIN],
    "idm": ["observation", NEXT, "action", ("next", "done"), TWIN],
}
DEFAULT_KEYS = {
    "action": "action",
    "state_action_value": "state_action_value",
    "value": "state_value",
    "reward": "reward",
    "done": "done",
    "terminated": "terminated",
    "priority": "td_error",
    "priority_weight": "priority_weight",
    "perturbed": "perturbed",
}


def build(name: str, networks, **kwargs):
    """A float64 loss whose target networks somebody moves."""
    if name == "idm":
        kwargs.pop("scalar_output_mode", None)
        return InverseDynamicsLoss(networks.inverse_dynamics, **kwargs)
    kwargs |= {"num_random": 3, "alpha_init": 0.5}
    kwargs["recovery_weight"] = 0.5 * (name != "cql")
    loss_class = OSRVLoss if name == "osrv" else OSRLoss
    loss = loss_class(
        networks.actor, networks.critics, networks.inverse_dynamics, **kwargs
    ).double()
    SoftUpdate(loss, tau=0.1)
    return loss


def seeded(loss, *args, **kwargs):
    torch.manual_seed(2)
    return loss(*args, **kwargs)


def assert_same(got: TensorDict, wanted: TensorDict, keys) -> None:
    for key in keys:
        torch.testing.assert_close(got[key], wanted[key], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_in_keys_are_stable_and_enough(make_networks, make_batch, name) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    assert loss.in_keys == IN_KEYS[name]
    everything = seeded(loss, batch)
    assert_same(seeded(loss, batch.select(*loss.in_keys)), everything, OUT_KEYS[name])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("reduction", "mode"),
    [
        ("mean", None),
        ("sum", None),
        (None, None),
        ("none", "exclude"),
        ("none", "non_tensor"),
    ],
)
def test_out_keys_are_what_forward_returns(
    make_networks, make_batch, name, reduction, mode
) -> None:
    loss = build(name, make_networks(), reduction=reduction, scalar_output_mode=mode)
    out = loss(make_batch(10))
    assert list(out.keys()) == loss.out_keys
    expected = LOSS_KEYS if mode == "exclude" else OUT_KEYS
    assert loss.out_keys == expected[name]


@pytest.mark.parametrize("name", MODES)
def test_reduction_none_warns_about_the_metrics_it_drops(make_networks, name) -> None:
    with pytest.warns(UserWarning, match="leaves its scalar metrics out"):
        loss = build(name, make_networks(), reduction="none")
    assert loss.out_keys == LOSS_KEYS[name]


@pytest.mark.parametrize("name", NAMES)
def test_keys_have_defaults_can_be_renamed_and_restored(make_networks, name) -> None:
    loss = build(name, make_networks())
    keys = vars(loss.tensor_keys)
    assert keys == {key: DEFAULT_KEYS[key] for key in keys}
    for key in list(keys):
        loss.set_keys(**{key: ("group", "renamed")})
        assert getattr(loss.tensor_keys, key) == ("group", "renamed")
        loss.set_keys(**{key: None})
        assert getattr(loss.tensor_keys, key) == DEFAULT_KEYS[key]
    assert loss.in_keys == IN_KEYS[name]
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(unknown="renamed")


RENAMED = {
    "action": ("agent", "action"),
    "perturbed": "noisy",
    "reward": ("agent", "reward"),
    "done": ("agent", "done"),
    "terminated": "over",
    "priority": ("agent", "priority"),
}


def renamed_batch(batch: TensorDict) -> TensorDict:
    batch = batch.rename_key_("action", ("agent", "action"))
    batch = batch.rename_key_("observation", ("agent", "observation"))
    batch = batch.rename_key_("perturbed", "noisy")
    noisy, following = batch["noisy"], batch["next"]
    for entry in (noisy, following):
        entry.rename_key_("observation", ("agent", "observation"))
    following.rename_key_("reward", ("agent", "reward"))
    following.rename_key_("done", ("agent", "done"))
    following.rename_key_("terminated", "over")
    return batch


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("estimator", ["before", "after", "never"])
def test_nested_and_renamed_keys_give_the_same_numbers(
    make_networks, make_batch, name, estimator
) -> None:
    batch = make_batch(10)
    expected = seeded(build(name, make_networks()), batch)
    networks = make_networks(
        observation=("agent", "observation"), action=("agent", "action")
    )
    loss, renamed = build(name, networks), renamed_batch(make_batch(10))
    has_estimator = name != "idm"
    if estimator == "before" and has_estimator:
        loss.make_value_estimator(gamma=0.99)
    accepted = vars(loss.tensor_keys)
    loss.set_keys(**{key: RENAMED[key] for key in RENAMED if key in accepted})
    if estimator == "after" and has_estimator:
        loss.make_value_estimator(gamma=0.99)
    out = seeded(loss, renamed)
    assert_same(out, expected, OUT_KEYS[name])
    if has_estimator:
        assert torch.equal(renamed["agent", "priority"], batch["td_error"])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_keyword_call_equals_tensordict_call(
    make_networks, make_batch, name, reduction
) -> None:
    mode = "exclude" if reduction == "none" else None
    loss = build(name, make_networks(), reduction=reduction, scalar_output_mode=mode)
    batch = make_batch(10)
    inputs = {
        key if isinstance(key, str) else "_".join(key): batch[key]
        for key in loss.in_keys
    }
    expected = seeded(loss, batch)
    found = seeded(loss, **inputs)
    found = found if isinstance(found, tuple) else (found,)
    for value, key in zip(found, loss.out_keys, strict=True):
        torch.testing.assert_close(value, expected[key], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", MODES)
def test_selected_out_keys_are_all_that_comes_back(
    make_networks, make_batch, name
) -> None:
    loss, batch = build(name, make_networks()), make_batch(10)
    expected = seeded(loss, batch)
    selected = ["loss_actor", LOSS_KEYS[name][-1]]
    loss.select_out_keys(*selected)
    out = seeded(loss, batch)
    assert set(out.keys()) == set(selected)
    assert_same(out, expected, out.keys())
    loss.reset_out_keys()
    assert list(seeded(loss, batch).keys()) == OUT_KEYS[name]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(10,), (2, 5)])
def test_reductions_agree(make_networks, make_batch, name, size) -> None:
    batch, out = make_batch(*size), {}
    for reduction in REDUCTIONS:
        mode = "exclude" if reduction == "none" else None
        loss = build(
            name, make_networks(), reduction=reduction, scalar_output_mode=mode
        )
        out[reduction] = seeded(loss, batch)
    assert out["none"].batch_size == batch.batch_size
    done = batch["next", "done"].squeeze(-1)
    for key in LOSS_KEYS[name]:
        each = out["none"][key]
        assert each.shape == size
        # Rows without a next state count neither in the sum nor in the number of rows.
        skips = key in ("loss_recovery", "loss_inverse_dynamics")
        assert ((each == 0) == (done & skips)).all()
        rows = (~done).sum() if skips else done.numel()
        torch.testing.assert_close(out["sum"][key], each.sum())
        torch.testing.assert_close(out["mean"][key], each.sum() / rows)


@pytest.mark.parametrize("name", NAMES)
def test_time_dimension_changes_no_number(make_networks, make_batch, name) -> None:
    # The same rows, [10] and [2, 5]: the draws have the same count and order.
    flat = make_batch(10)
    shaped = flat.reshape(2, 5)
    expected = seeded(build(name, make_networks()), flat)
    out = seeded(build(name, make_networks()), shaped)
    assert_same(out, expected, OUT_KEYS[name])
    if name != "idm":
        assert torch.equal(shaped["td_error"], flat["td_error"].reshape(2, 5))
