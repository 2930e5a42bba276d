"""How losses call networks of any kind, and which ones they refuse."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives.losses import (
    BUILDERS,
    LOSSES,
    NEXT,
    PERTURBED,
    WITH_CRITICS,
    Networks,
    S,
    assert_same,
    assert_same_bits,
    call,
    make_batch,
    make_loss,
    make_networks,
    parts,
    record,
    with_critics,
)
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, GRUModule, TanhModule

from torchrl_osr import StateRecoveryLoss


def critics_of(name: str, networks: Networks) -> list[TensorDictModule]:
    return networks.choice_critics if "discrete" in name else networks.critics


class Seeing(nn.Module):
    """A network of features behind a frozen encoder of images, one batch dimension."""

    def __init__(self, core: nn.Module, encoder: nn.Module) -> None:
        super().__init__()
        self.core, self.encoder = core, copy.deepcopy(encoder).requires_grad_(False)

    def forward(self, *inputs: Tensor) -> object:
        return self.core(*(self.encoder(x) if x.ndim > 2 else x for x in inputs))


def seeing(name: str, encoder: nn.Module) -> Networks:
    """Return a loss's networks, each with an encoder of its own."""
    networks = make_networks(name)
    for each in set(BUILDERS) - {"latent_model", "dynamics", "vae"}:
        built = getattr(networks, each)
        for network in built if isinstance(built, list) else [built]:
            while isinstance(network, TensorDictSequential):
                network = network[0]
            network.module = Seeing(network.module, encoder)
    return networks


# Those hand the state itself to a model of the dynamics, or perturb it themselves.
@pytest.mark.parametrize("name", sorted({*LOSSES} - {"latent-model", "sdc", "rorl"}))
def test_images_reach_convolutions_with_one_batch_dimension(name) -> None:
    encoder = nn.Sequential(nn.Conv2d(1, S, 2), nn.Flatten()).double()
    for size in ((6,), (2, 3)):
        images, batch = make_batch(name, *size), make_batch(name, *size)
        for key in ("observation", NEXT, PERTURBED):
            images[key] = torch.randn(*size, 1, 2, 2, dtype=torch.float64)
            features = encoder(images[key].flatten(0, len(size) - 1)).detach()
            batch[key] = features.reshape(*size, S)
        found = call(make_loss(name, seeing(name, encoder)), images)
        assert_same([*found.values()], [*call(make_loss(name), batch).values()])


class WithGoal(nn.Module):
    def __init__(self, core: nn.Module) -> None:
        super().__init__()
        self.core = core

    def forward(self, state: Tensor, goal: Tensor, *action: Tensor) -> Tensor:
        return self.core(state, *action) + goal


# RORL draws noise for the goal, too.
@pytest.mark.parametrize("name", sorted({*WITH_CRITICS} - {"rorl"}))
def test_critics_may_read_more_than_the_actor(name) -> None:
    networks, batch = make_networks(name), make_batch(name, 10)
    expected = record(make_loss(name), batch)
    for critic in critics_of(name, networks):
        critic.module = WithGoal(critic.module)
        critic.in_keys = ["observation", "goal", *critic.in_keys[1:]]
    loss = make_loss(name, networks)
    for group in (batch, batch["next"], batch.setdefault("perturbed", {})):
        group["goal"] = torch.zeros(10, 1)
    assert_same(record(loss, batch.select(*loss.in_keys)), expected)


@with_critics
def test_critics_may_be_a_list_of_any_length_or_one_to_be_copied(name) -> None:
    batch = make_batch(name, 10)
    for number in [1, 3] if name not in ("edac", "rorl") else [3]:
        networks = make_networks(name, number=number)
        loss = make_loss(name, networks)
        held = parts(loss)[0].qvalue_network_params.flatten_keys(".")
        weights = [dict(each.named_parameters()) for each in critics_of(name, networks)]
        for key in weights[0]:
            assert torch.equal(held[key].data, torch.stack([w[key] for w in weights]))
        loss(batch)["loss_qvalue"].backward()
        # TorchRL 0.14.1 by itself would hide those of a list of one.
        assert {id(held[key]) for key in weights[0]} <= {*map(id, loss.parameters())}
        assert all(held[key].grad.any() for key in weights[0])
    kind = "choice_critics" if "discrete" in name else "critics"
    setattr(networks, kind, getattr(networks, kind)[0])
    loss = make_loss(name, networks, num_qvalue_nets=4)
    first = next(parts(loss)[0].qvalue_network_params.parameters())
    assert len(first) == 4
    assert not torch.equal(first[0], first[1])


@with_critics
def test_a_list_of_unlike_critics_is_refused(name) -> None:
    for change in (
        lambda critic: critic.module.insert(1, nn.Dropout(0.1)),
        lambda critic: critic.module.__setitem__(1, nn.Sigmoid()),
        lambda critic: critic.requires_grad_(False),
    ):
        networks = make_networks(name, number=3)
        change(critics_of(name, networks)[1])
        with pytest.raises(ValueError, match="qvalue_network differ"):
            make_loss(name, networks)


def test_networks_with_common_parameters_are_refused() -> None:
    networks, other, third = Networks(), Networks(), Networks()
    networks.critics = [networks.critics[0]] * 2
    other.critics[0].module[0].bias = next(other.actor.parameters())
    third.model[0][0].module[0].bias = next(third.actor.parameters())
    for each in (networks, other, third):
        with pytest.raises(ValueError, match=r"share a parameter of shape .*deepcopy"):
            make_loss("osr", each)


@pytest.mark.parametrize("name", ["osr", "osr-v", "recovery", "recovery-delta"])
def test_a_model_of_other_bounds_or_actions_is_refused(name) -> None:
    networks = Networks()
    networks.model = Networks(high=torch.tensor([1.0, 2.0])).model
    with pytest.raises(ValueError, match=r"share their action bounds.*\[1.0, 2.0\]"):
        make_loss(name, networks)
    for size in (1, 3):  # 1 would broadcast against any policy
        networks = Networks()
        networks.model[0][0].module = MLP(2 * S, 2 * size, num_cells=[8]).double()
        with pytest.raises(ValueError, match=f"has {size} actions, but actor_network"):
            make_loss(name, networks)(make_batch(name, 4))


CHOICES = [("osr", "reduction"), ("model", "loss_function"), ("osr-v", "policy_values")]
CHOICES += [("osr-v", "recovery_target"), ("recovery", "recovery_target")]


@pytest.mark.parametrize(("name", "option"), CHOICES)
def test_a_misspelt_choice_is_refused(name, option) -> None:
    with pytest.raises(ValueError, match=f"{option} must be one of"):
        make_loss(name, **{option: "l2"})


def test_recurrent_actors_and_actors_of_other_bounds_are_refused() -> None:
    gru = GRUModule(S, 8, in_key="observation", out_key="hidden")
    layer = TensorDictModule(nn.Linear(8, 2), ["hidden"], ["action"])
    with pytest.raises(ValueError, match="actor_network is recurrent"):
        StateRecoveryLoss(TensorDictSequential(gru, layer), recovery_target="data")
    layer = TensorDictModule(nn.Linear(S, 2), ["observation"], ["action"])
    tanh = TanhModule(in_keys=["action"], low=-2.0, high=2.0)
    actor, model = TensorDictSequential(layer, tanh), Networks().model
    with pytest.raises(ValueError, match="share their action bounds"):
        StateRecoveryLoss(actor, model)
    for name in ("td3-bc", "rebrac"):
        with pytest.raises(ValueError, match="pass low= and high="):
            make_loss(name, low=None)


FROZEN = dict.fromkeys(["osr", "recovery", "official"], ("model", "recovery_kl"))
FROZEN |= {"osr-v": ("model", "recovery_gap"), "sdc": ("dynamics", "deviation")}
FROZEN["discrete"] = "choice_model", "recovery_kl"


@pytest.mark.parametrize("name", FROZEN)
def test_a_frozen_model_is_followed_and_never_trained(name) -> None:
    """It may be trained in place after the loss was built."""
    kind, metric = FROZEN[name]
    networks, batch = make_networks(name), make_batch(name, 10)
    loss, model = make_loss(name, networks), getattr(networks, kind)
    assert not {*map(id, loss.parameters())} & {*map(id, model.parameters())}
    before = call(loss, batch)
    sum(before[key] for key in LOSSES[name].trains).backward()
    assert all(each.grad is None for each in model.parameters())
    for parameter in model.parameters():
        parameter.data.add_(0.3)
    after = call(loss, batch)
    assert after[metric] != before[metric]
    assert torch.equal(call(make_loss(name, networks), batch)[metric], after[metric])
    assert model not in vars(loss).values(), "an error in it would empty the model"


def test_a_frozen_network_has_the_weights_that_a_loss_loads() -> None:
    loss, other = make_loss("osr"), make_loss("osr", make_networks("osr", seed=9))
    loss.load_state_dict(other.state_dict())
    assert not loss.inverse_dynamics_network.training, "labels would be random"
    held = [*loss.inverse_dynamics_network.parameters()]
    assert held
    assert_same_bits(held, [*other.inverse_dynamics_network.parameters()])
    model = make_networks("osr", seed=4).model
    loss.from_stateful_net("inverse_dynamics_network", model)
    held = [*loss.inverse_dynamics_network.parameters()]
    assert_same_bits(held, [*model.parameters()])


def test_a_policy_that_is_first_asked_without_gradient_has_one() -> None:
    loss = make_loss("cql")
    policy = loss.policy(loss.unpack(make_batch("cql", 4)))
    with torch.no_grad():
        policy["clean"]
    assert policy["clean"].loc.requires_grad


def test_a_loss_is_where_its_networks_are(monkeypatch) -> None:
    monkeypatch.setattr(Tensor, "is_set_to", lambda *_: False)  # no meta kernel
    networks = make_networks("cql-options")
    for each in (networks.actor, *networks.critics):
        each.to("meta")
    loss = make_loss("cql-options", networks)
    numbers = [*loss.parameters(), *loss.buffers(recurse=False)]
    assert len(numbers) > 5
    assert all(each.is_meta for each in numbers)
