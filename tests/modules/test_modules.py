"""Networks: shapes, bounds, initialisation, and that policy and model match."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type

from torchrl_osr import OSRLoss
from torchrl_osr.modules import (
    critic_ensemble,
    deterministic_actor,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

BUILDERS = [tanh_gaussian_actor, tanh_gaussian_inverse_dynamics]
BOUNDS = [
    (-1.0, 1.0),
    (-0.4, 0.4),
    (torch.tensor([-1.0, 0.0]), torch.tensor([2.0, 3.0])),
]


def states(*size: int, scale: float = 1.0) -> TensorDict:
    observation, next_observation = scale * torch.randn(2, *size, 5)
    next_states = {"observation": next_observation}
    return TensorDict({"observation": observation, "next": next_states}, size)


@pytest.mark.parametrize("build", BUILDERS)
@pytest.mark.parametrize("size", [(7,), (2, 3)])
def test_outputs_have_one_entry_an_action_dimension(build, size) -> None:
    out = build(5, 2, num_cells=[8])(states(*size))
    for key in ("loc", "scale", "action"):
        assert out[key].shape == (*size, 2)
    assert out["action_log_prob"].shape == size


@pytest.mark.parametrize("build", [*BUILDERS, deterministic_actor])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_actions_fill_their_bounds_and_never_leave_them(build, low, high) -> None:
    # Inputs of this size saturate the tanh at both ends.
    action = build(5, 2, num_cells=[8], low=low, high=high)(states(500, scale=300))
    action = action["action"]
    low, high = torch.as_tensor(low), torch.as_tensor(high)
    assert (action >= low).all()
    assert (action <= high).all()
    width = high - low
    assert (action.amin(0) < low + 0.1 * width).all()
    assert (action.amax(0) > high - 0.1 * width).all()


@pytest.mark.parametrize("size", [(7,), (2, 3)])
@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_deterministic_action_is_the_squashed_output(size, low, high) -> None:
    actor = deterministic_actor(5, 2, num_cells=[8], low=low, high=high)
    batch = states(*size)
    out = actor(batch.clone())
    assert set(out.keys(True, True)) - set(batch.keys(True, True)) == {
        "param",
        "action",
    }
    # By hand: the network's output, moved by the interval's center as TorchRL's
    # TanhDelta does, a tanh, and the interval.
    param = actor.module[0].module(batch["observation"])
    low, high = torch.as_tensor(low), torch.as_tensor(high)
    center, half = (low + high) / 2, (high - low) / 2
    wanted = center + half * (param + center).tanh()
    torch.testing.assert_close(out["action"], wanted)
    # Nothing is drawn, whatever is asked for.
    with set_interaction_type(InteractionType.RANDOM):
        assert torch.equal(actor(batch.clone())["action"], out["action"])


def test_deterministic_action_passes_the_gradient_of_its_tanh() -> None:
    actor = deterministic_actor(5, 2, num_cells=[8])
    out = actor(states(4))
    (slope,) = torch.autograd.grad(out["action"].sum(), out["param"])
    torch.testing.assert_close(slope, 1 - out["param"].tanh().square())


@pytest.mark.parametrize("build", BUILDERS)
def test_scale_has_a_floor(build) -> None:
    # The KL divides by the variance: 1e-2 is as sure as a network can get.
    scale = build(5, 2, num_cells=[8]).get_dist(states(500, scale=1e4)).scale
    assert scale.min().item() == pytest.approx(1e-2)


def test_model_reads_both_states_and_the_policy_only_the_first() -> None:
    before = states(4)
    after = before.clone()
    after["next", "observation"] += 1
    moved = [
        not torch.equal(network.get_dist(before).loc, network.get_dist(after).loc)
        for network in (build(5, 2, num_cells=[8]) for build in BUILDERS)
    ]
    assert moved == [False, True]


@pytest.mark.parametrize("count", [1, 2, 10])
def test_critics_score_actions_and_differ(count) -> None:
    critics = critic_ensemble(5, 2, num_qvalue_nets=count, num_cells=[8])
    batch = states(4).set("action", torch.rand(4, 2))
    values = [critic(batch.clone())["state_action_value"] for critic in critics]
    assert [value.shape for value in values] == [(4, 1)] * count
    assert torch.stack(values).unique(dim=0).shape[0] == count


def test_critics_keep_torchs_default_initialisation_in_the_loss() -> None:
    # torch.nn.Linear draws uniformly within +-1/sqrt(fan in). TorchRL's own copies of
    # one network are drawn between the extremes of each tensor instead.
    torch.manual_seed(3)
    critics = critic_ensemble(5, 2, num_cells=[400])
    torch.manual_seed(3)
    for critic in critics:
        for layer in (torch.nn.Linear(7, 400), torch.nn.Linear(400, 1)):
            name = "0" if layer.in_features == 7 else "2"
            assert torch.equal(
                critic.module.get_parameter(f"{name}.weight"), layer.weight
            )
    networks = (build(5, 2, num_cells=[8]) for build in BUILDERS)
    actor, model = networks
    loss = OSRLoss(actor, critics, model)
    weight = loss.qvalue_network_params["module", "2", "weight"]
    for kept, critic in zip(weight, critics, strict=True):
        assert torch.equal(kept, critic.module[2].weight)


@pytest.mark.parametrize("build", [*BUILDERS, deterministic_actor, critic_ensemble])
def test_width_depth_and_activation_are_as_asked(build) -> None:
    network = build(5, 2, num_cells=[6, 4], activation_class=torch.nn.Tanh)
    network = network[0] if isinstance(network, list) else network
    layers = [m for m in network.modules() if isinstance(m, torch.nn.Linear)]
    assert [layer.out_features for layer in layers[:2]] == [6, 4]
    assert sum(isinstance(m, torch.nn.Tanh) for m in network.modules()) == 2


def test_layer_norm_normalises_each_hidden_layer_before_its_activation() -> None:
    torch.manual_seed(0)
    (critic,) = critic_ensemble(
        3, 2, num_qvalue_nets=1, num_cells=[16, 8], layer_norm=True
    )
    state, action = torch.randn(5, 3), torch.randn(5, 2)
    value = critic(TensorDict({"observation": state, "action": action}, [5]))[
        "state_action_value"
    ]
    # The same network restated layer by layer from its weights.
    first, second, last = (
        m for m in critic.modules() if isinstance(m, torch.nn.Linear)
    )
    hidden = torch.cat([state, action], -1)
    for layer in (first, second):
        hidden = layer(hidden)
        spread, mean = torch.std_mean(hidden, -1, keepdim=True, correction=0)
        hidden = ((hidden - mean) / (spread.square() + 1e-5).sqrt()).relu()
    torch.testing.assert_close(value, last(hidden))
