"""SCASLoss against a plain restatement of its equations, in its three versions.

"Offline Reinforcement Learning with OOD State Correction and OOD Action Suppression"
(Mao et al. 2024, https://arxiv.org/abs/2410.19400).
"""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor
from torchrl.objectives import SoftUpdate
from uneven_dynamics import uneven_dynamics

from torchrl_osr.lab.dynamics import DynamicsEnsemble
from torchrl_osr.lab.losses import SCASLoss

GAMMA, NOISE, CLIP, TARGET_SCALE = 0.875, 0.6, 0.5, 0.8
LOW, HIGH, SHARE, LARGEST = -0.8, 0.7, 0.3, 1.1
VERSIONS = {
    "released": ("clean", 2.0),
    "printed": ("perturbed", 2.0),
    "without weights": ("clean", 0.0),
}


@pytest.fixture
def networks(make_networks, make_deterministic_actor):
    found = make_networks(num_critics=3)
    found.actor = make_deterministic_actor("module")
    return found


def make_loss(networks, version: str, **options) -> SCASLoss:
    """A loss with every number off its default and targets of their own."""
    action, temperature = VERSIONS[version]
    numbers = {"policy_noise": NOISE, "noise_clip": CLIP, "low": LOW, "high": HIGH}
    numbers |= {"correction_weight": SHARE, "largest_weight": LARGEST}
    loss = SCASLoss(
        networks.actor,
        networks.critics,
        uneven_dynamics(),
        correction_action=action,
        gain_temperature=temperature,
        **(numbers | options),
    ).double()
    loss.make_value_estimator(gamma=GAMMA)
    SoftUpdate(loss, tau=0.1)
    for params in (loss.target_qvalue_network_params, loss.target_actor_network_params):
        params.apply_(lambda tensor: tensor.mul_(TARGET_SCALE))
    return loss


def next_state(model: DynamicsEnsemble, state: Tensor, action: Tensor) -> Tensor:
    """The elites' mean, network by network."""
    inputs = (torch.cat([state, action]) - model.input_loc) / model.input_scale
    changes = []
    for number in (0, 2):
        first, last = model.layers
        hidden = first.weight[number].T @ inputs + first.bias[number, 0]
        hidden = hidden * torch.sigmoid(hidden)
        out = (last.weight[number].T @ hidden + last.bias[number, 0])[:4]
        changes.append((out * model.target_scale + model.target_loc)[:3])
    return state + sum(changes) / 2


def restated(networks, batch, version: str) -> dict[str, Tensor]:
    """The losses, one critic and one row at a time; no loss of torchrl_osr."""
    correction, temperature = VERSIONS[version]
    critics, actor, model = networks.critics, networks.actor.module, uneven_dynamics()
    critics = [each.module for each in critics]
    old_critics, old_actor = copy.deepcopy((critics, actor))
    for network in (*old_critics, old_actor):
        for parameter in network.parameters():
            parameter.data.mul_(TARGET_SCALE)
    torch.manual_seed(5)
    noise = torch.randn(len(batch), 2, dtype=torch.float64)
    noise = (NOISE * noise).clip(-CLIP, CLIP)

    def values(state: Tensor, action: Tensor, of) -> Tensor:
        return torch.stack([each(torch.cat([state, action]))[0] for each in of])

    qvalue, error, distance, kept = [], [], [], 0
    for row, drawn in zip(batch, noise, strict=True):
        s, a, after = row["observation"], row["action"], row["next"]
        target = after["reward"][0]
        following = after["observation"]
        if not after["terminated"]:
            action = (old_actor(following) + drawn).clip(LOW, HIGH)
            target = target + GAMMA * values(following, action, old_critics).min()
        distance.append((values(s, a, critics) - target.detach()).square().sum())
        frozen = [copy.deepcopy(each).requires_grad_(False) for each in critics]
        qvalue.append(values(s, actor(s), frozen).min())
        if after["done"]:
            continue
        kept += 1
        gain = values(following, actor(following), frozen).mean()
        gain = gain - values(s, actor(s), frozen).mean()
        weight = min(torch.exp(temperature * gain).item(), LARGEST)
        perturbed = row["perturbed", "observation"]
        acts_at = perturbed if correction == "perturbed" else s
        reached = next_state(model, perturbed, actor(acts_at))
        error.append(weight * (reached - following).square().sum() / 3)
    qvalue = torch.stack(qvalue)
    sought = -(qvalue / qvalue.abs().mean().detach()).mean()
    return {
        "loss_actor": (1 - SHARE) * sought + SHARE * sum(error) / kept,
        "loss_qvalue": torch.stack(distance).mean(),
    }


@pytest.mark.parametrize("version", VERSIONS)
def test_losses_and_gradients_equal_the_restatement(
    networks, make_batch, check, version
) -> None:
    batch, plain = make_batch(10), copy.deepcopy(networks)
    loss = make_loss(networks, version)
    torch.manual_seed(5)
    out = loss(batch)
    wanted = restated(plain, batch, version)
    for key, parts, others in (
        ("loss_actor", [networks.actor], [plain.actor]),
        ("loss_qvalue", [loss.qvalue_network_params], plain.critics),
    ):
        here = [each for part in parts for each in part.parameters()]
        there = [each for part in others for each in part.parameters()]
        got = torch.autograd.grad(out[key], here, retain_graph=True)
        expected = torch.autograd.grad(wanted[key], there, retain_graph=True)
        if key == "loss_qvalue":  # the loss stacks its critics
            stacked = zip(*[iter(expected)] * (len(expected) // 3), strict=True)
            expected = [torch.stack(each) for each in zip(*stacked, strict=True)]
            got, expected = (
                sorted(each, key=lambda tensor: (tensor.shape, tensor.sum().item()))
                for each in (got, expected)
            )
        check(
            "SCAS",
            [out[key].detach(), *got],
            [wanted[key].detach(), *expected],
            tolerance=1e-10,
        )


def test_the_model_is_frozen_and_can_be_given_later(networks, make_batch) -> None:
    loss, batch = make_loss(networks, "released"), make_batch(10)
    loss(batch)
    held = {each.data_ptr() for each in loss.parameters()}
    names = [key for key in loss.state_dict() if "dynamics" in key]
    assert any(key.endswith("weight") for key in names)
    frozen = loss.dynamics_network_params.values(True, True)
    assert not held & {each.data_ptr() for each in frozen}
    before = loss(batch)["correction_error"]
    other = uneven_dynamics()
    with torch.no_grad():
        other.layers[-1].bias += 1
    loss.load_network("dynamics_network", other)
    assert loss(batch)["correction_error"] != before
    loss.load_network("dynamics_network", uneven_dynamics())
    assert loss(batch)["correction_error"] == before
    with pytest.raises(ValueError, match="other sizes"):
        loss.load_network(
            "dynamics_network", DynamicsEnsemble(3, 2, num_cells=[6]).double()
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"correction_weight": 1.5}, "correction_weight must be at most 1"),
        ({"correction_action": "both"}, "correction_action must be one of"),
        ({"largest_weight": 0.0}, "largest_weight must be above 0"),
        ({"gain_temperature": -1.0}, "gain_temperature must be at least 0"),
    ],
)
def test_options_are_checked(networks, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        SCASLoss(networks.actor, networks.critics, uneven_dynamics(), **options)


def test_the_correction_and_its_weight_are_of_single_steps(
    networks, make_batch
) -> None:
    single = make_batch(10)
    several = single.clone().set("next", single["next"].roll(1, 0))
    several["steps_to_next_obs"] = torch.full((10, 1), 5)
    loss = make_loss(networks, "released", largest_weight=9.0)
    with pytest.raises(ValueError, match="up to 5.*the model of the dynamics reads"):
        loss(several)
    kept = several.set("one_step", single["next"])
    assert torch.equal(loss(kept)["loss_actor"], loss(single)["loss_actor"])
    assert not torch.equal(loss(kept)["loss_qvalue"], loss(single)["loss_qvalue"])
