"""Networks are copied whole, or refused."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import ObservationNorm
from torchrl.modules import MLP, NormalParamExtractor, ValueOperator

from torchrl_osr import CQLLoss
from torchrl_osr.lab.losses import BCLoss, TD3BCLoss
from torchrl_osr.modules import critic_ensemble, tanh_gaussian_actor
from torchrl_osr.policy import policy_from_loss


def test_networks_that_a_policy_would_not_copy_whole():
    def actor(*layers: nn.Module, **bounds):
        network = nn.Sequential(*layers, MLP(3, 4), NormalParamExtractor())
        actor = tanh_gaussian_actor(3, 2, **bounds)
        actor.module[0].module = network
        return actor

    def activated(activation: type[nn.Module]):
        return tanh_gaussian_actor(3, 2, activation_class=activation)

    critics = critic_ensemble(3, 2)
    policy_from_loss(CQLLoss(actor(), critics))
    swapped = ValueOperator(MLP(5, 1), in_keys=["action", "observation"])
    for networks, message in [
        ((actor(nn.LayerNorm(3)), critics), "compute something else"),
        ((actor(nn.Hardtanh(-5.0, 5.0)), critics), "compute something else"),
        ((actor(low=-2.0, high=2.0), critics), "compute something else"),
        ((actor(), swapped), "compute something else"),
        ((actor(MLP(3, 3)), critics), "one torchrl.modules.MLP.* has 2"),
        ((activated(nn.Mish), critics), "layers that no policy has, .*'Mish'"),
        ((actor(nn.Linear(5, 3)), critics), "layers that no policy has"),
    ]:
        loss = CQLLoss(*networks)
        with pytest.raises(ValueError, match=message):
            policy_from_loss(loss)
    plain = TensorDictModule(MLP(3, 2), ["observation"], ["action"])
    with pytest.raises(ValueError, match="this one has no distribution"):
        policy_from_loss(TD3BCLoss(plain, critics, low=-1.0, high=1.0))


def test_statistics_and_bounds_that_are_refused(make_loss):
    norm = ObservationNorm(loc=1.0, scale=4.0, in_keys=["observation"])
    with pytest.raises(ValueError, match="standard_normal=True"):
        policy_from_loss(make_loss("osr"), observation_norm=norm)
    for bounds in ({"low": 1.0}, {"high": [1.0, float("inf")]}):
        with pytest.raises(ValueError, match="must be below high"):
            policy_from_loss(make_loss("osr"), **bounds)


def test_torchs_default_type_is_not_that_of_a_policy(make_loss):
    loss = make_loss("osr")
    torch.set_default_dtype(torch.float64)
    try:
        assert policy_from_loss(loss).loc.dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


def test_without_critics_it_acts_and_has_no_values(tmp_path):
    policy = policy_from_loss(BCLoss(tanh_gaussian_actor(3, 2)))
    for use in (policy.value, lambda _: policy.export(tmp_path / "v.pt2", "value")):
        with pytest.raises(ValueError, match="no critics"):
            use(policy.loc)
