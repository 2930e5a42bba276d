"""A model that nobody has trained is noticed; trained or loaded ones never are."""

from __future__ import annotations

import copy
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from torchrl_osr import (
    DiscreteOSRLoss,
    InverseDynamicsLoss,
    OSRLoss,
    OSRVLoss,
    StatePerturbation,
    StateRecoveryLoss,
)
from torchrl_osr.modules import (
    categorical_actor,
    categorical_inverse_dynamics,
    critic_ensemble,
    cvae_inverse_dynamics,
    discrete_critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

CELLS = {"num_cells": [8]}
MODELS = [tanh_gaussian_inverse_dynamics, cvae_inverse_dynamics]
# The package's own tests ignore the warning (pyproject.toml): here it is asked for.
pytestmark = pytest.mark.filterwarnings("error:.*never trained")


def batch(discrete: bool = False) -> TensorDict:
    no = torch.zeros(6, 1, dtype=torch.bool)
    action = (
        nn.functional.one_hot(torch.arange(6) % 2) if discrete else torch.rand(6, 2)
    )
    following = {"observation": torch.randn(6, 3), "reward": torch.randn(6, 1)}
    following |= {"done": no, "terminated": no.clone()}
    data = {"observation": torch.randn(6, 3), "action": action, "next": following}
    return StatePerturbation(0.1)(TensorDict(data, [6]))


def make_loss(model, loss_class=OSRLoss):
    if loss_class is StateRecoveryLoss:
        return loss_class(tanh_gaussian_actor(3, 2, **CELLS), model)
    if loss_class is DiscreteOSRLoss:
        networks = categorical_actor(3, 2, **CELLS), discrete_critic_ensemble(3, 2)
    else:
        networks = tanh_gaussian_actor(3, 2, **CELLS), critic_ensemble(3, 2, **CELLS)
    loss = loss_class(*networks, model)
    SoftUpdate(loss, tau=0.1)
    return loss


@pytest.mark.parametrize("build", MODELS)
@pytest.mark.parametrize("loss_class", [OSRLoss, OSRVLoss, StateRecoveryLoss])
def test_an_untrained_model_is_named_once(build, loss_class) -> None:
    loss = make_loss(build(3, 2, **CELLS), loss_class)
    expected = rf"{loss_class.__name__} uses an inverse .* never trained"
    with pytest.warns(UserWarning, match=expected) as caught:
        loss(batch())
    assert [each.filename for each in caught] == [__file__]
    loss(batch())


def test_an_untrained_categorical_model_is_named() -> None:
    loss = make_loss(categorical_inverse_dynamics(3, 2, **CELLS), DiscreteOSRLoss)
    with pytest.warns(UserWarning, match="never trained"):
        loss(batch(discrete=True))


def own_optimizer(model) -> None:
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-6)
    distribution = model.get_dist(batch())
    (-distribution.log_prob(torch.rand(6, 2))).mean().backward()
    optimizer.step()


def inverse_dynamics_loss(model) -> None:
    loss = InverseDynamicsLoss(model)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-6)
    loss(batch())["loss_inverse_dynamics"].backward()
    optimizer.step()


def load(model, **options) -> None:
    trained = copy.deepcopy(model)
    own_optimizer(trained)
    model.load_state_dict(trained.state_dict(), **options)


def last_layer_alone(model) -> None:
    model.requires_grad_(False)
    last = [each for each in model.modules() if isinstance(each, nn.Linear)][-1]
    last.requires_grad_(True)
    own_optimizer(model)


def new_data(model) -> None:
    for parameter in model.parameters():
        parameter.data = parameter.data + 0.1


TRAINED = [
    own_optimizer,
    inverse_dynamics_loss,
    load,
    lambda model: load(model, assign=True),
    last_layer_alone,
    new_data,
]


@pytest.mark.parametrize("build", MODELS)
@pytest.mark.parametrize("train", TRAINED)
def test_a_trained_or_loaded_model_raises_no_alarm(build, train) -> None:
    model = build(3, 2, **CELLS)
    train(model)
    make_loss(model)(batch())
    make_loss(copy.deepcopy(model))(batch())


def test_weights_may_come_after_the_loss_was_built() -> None:
    model = tanh_gaussian_inverse_dynamics(3, 2, **CELLS)
    loss = make_loss(model)
    own_optimizer(model)
    loss(batch())
    fresh = make_loss(tanh_gaussian_inverse_dynamics(3, 2, **CELLS))
    fresh.load_state_dict(loss.state_dict())
    fresh(batch())


def test_an_untrained_model_is_noticed_after_a_copy_and_a_move() -> None:
    model = copy.deepcopy(tanh_gaussian_inverse_dynamics(3, 2, **CELLS))
    loss = copy.deepcopy(make_loss(model)).to("cpu")
    with pytest.warns(UserWarning, match="never trained"):
        loss(batch())


def test_the_state_dict_knows_nothing_of_it() -> None:
    model = tanh_gaussian_inverse_dynamics(3, 2, **CELLS)
    assert len(model.state_dict()) == len(list(model.parameters()))


def test_networks_of_others_are_not_looked_at() -> None:
    network = nn.Sequential(MLP(6, 4, num_cells=[8]), NormalParamExtractor())
    joint = TensorDictModule(
        lambda *states: torch.cat(states, -1),
        ["observation", ("next", "observation")],
        ["joint"],
    )
    head = TensorDictModule(network, ["joint"], ["loc", "scale"])
    model = ProbabilisticActor(
        TensorDictSequential(joint, head),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_loss(model)(batch())
