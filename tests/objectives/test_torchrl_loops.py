"""TorchRL's own training code trains every term of the losses.

Its CQLTrainer steps on the entries whose names it knows, and its scripts build an
optimizer for each group of parameters: a term in an entry of another name, or a group
that nobody lists, would be lost without an error.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from objectives.losses import assert_same_bits
from tensordict import TensorDict
from torch import Tensor
from torch.optim import Adam
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import CQLLoss, SoftUpdate
from torchrl.objectives.utils import group_optimizers
from torchrl.trainers.algorithms import CQLTrainer

from torchrl_osr import OSRLoss, OSRVLoss, StatePerturbation
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)

BOUNDS = {"low": -2.0, "high": 2.0, "num_cells": [8]}
LOSSES = {
    "osr": (OSRLoss, {"num_random": 3}),
    "osr-gap": (OSRLoss, {"num_random": 3, "target_action_gap": 1.0}),
    "osr-v": (OSRVLoss, {}),
}
# Raised by TorchRL 0.14.1's trainer about itself.
pytestmark = [
    pytest.mark.filterwarnings("ignore:CQLTrainer is an experimental:UserWarning"),
    pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning"),
]


def make_loss(loss_class: type = OSRLoss, **options: Any):
    """Return a loss for Pendulum; equal weights at each call."""
    torch.manual_seed(0)
    return loss_class(
        tanh_gaussian_actor(3, 1, **BOUNDS),
        critic_ensemble(3, 1, num_cells=[8]),
        tanh_gaussian_inverse_dynamics(3, 1, **BOUNDS),
        **options,
    )


def make_optimizer(loss) -> Adam:
    """Return one optimizer for each group of parameters, as TorchRL's scripts do."""
    optimizers = [
        Adam(list(loss.actor_network_params.flatten_keys().values()), lr=1e-2),
        Adam(list(loss.qvalue_network_params.flatten_keys().values()), lr=1e-2),
        Adam([loss.log_alpha], lr=1e-2),
    ]
    if loss.with_lagrange:
        optimizers.append(Adam([loss.log_alpha_prime], lr=1e-2))
    return group_optimizers(*optimizers)


def make_trainer(loss, optimizer) -> CQLTrainer:
    environment = GymEnv("Pendulum-v1")
    environment.set_seed(0)
    collector = Collector(
        environment,
        loss.actor_network,
        frames_per_batch=32,
        total_frames=64,
        auto_register_policy_transforms=True,
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(64), batch_size=16)
    buffer.append_transform(StatePerturbation(std=0.1))
    return CQLTrainer(
        collector=collector,
        total_frames=64,
        frame_skip=1,
        optim_steps_per_batch=3,
        loss_module=loss,
        optimizer=optimizer,
        replay_buffer=buffer,
        target_net_updater=SoftUpdate(loss, tau=0.1),
        progress_bar=False,
        enable_logging=False,
    )


@pytest.fixture
def batch(transitions) -> TensorDict:
    return StatePerturbation(std=0.1)(transitions(16, observation=3, action=1))


def gradients_of_all_losses(loss, batch: TensorDict) -> list[Tensor]:
    """Return those of the sum of every ``loss_*`` entry."""
    torch.manual_seed(2)
    out = loss(batch)
    total = sum(out[key] for key in loss.out_keys if key.startswith("loss_"))
    return list(torch.autograd.grad(total, list(loss.parameters())))


@pytest.mark.parametrize("kind", LOSSES)
def test_cql_trainer_steps_along_the_gradient_of_all_losses(batch, kind) -> None:
    loss_class, options = LOSSES[kind]
    loss = make_loss(loss_class, **options)
    SoftUpdate(reference := make_loss(loss_class, **options), tau=0.1)
    expected = gradients_of_all_losses(reference, batch.clone())
    optimizer, stepped = make_optimizer(loss), []
    trainer = make_trainer(loss, optimizer)
    optimizer.register_step_pre_hook(
        lambda *_: stepped.extend(each.grad.clone() for each in loss.parameters())
    )
    before = [parameter.detach().clone() for parameter in loss.parameters()]
    torch.manual_seed(2)
    trainer.optimization_stepper.step(trainer, batch)
    assert_same_bits(stepped, expected)
    assert not any(map(torch.equal, before, loss.parameters()))
    trainer.collector.shutdown()


def script_update(loss, optimizer, updater, data, policy_eval_start, iteration):
    """One step of TorchRL's script cql_offline.py, in our words."""
    values = loss(data)
    actor = torch.where(
        iteration >= policy_eval_start, values["loss_actor"], values["loss_actor_bc"]
    )
    values["q_loss"] = values["loss_qvalue"] + values["loss_cql"]
    temperatures = values["loss_alpha"] + values["loss_alpha_prime"]
    total = actor + values["q_loss"] + temperatures
    total.backward()
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    updater.step()
    return total.detach(), values.detach()


class WarmStart(OSRLoss):
    """OSR with TorchRL's entry for the first steps, which is not to be added up."""

    def __init__(self, *networks: Any, **options: Any) -> None:
        super().__init__(*networks, **options)
        self.out_keys = [*self.out_keys, "loss_actor_bc"]

    def losses(self, batch):
        losses, metrics = super().losses(batch)
        pi = self.policy(batch)["clean"]
        _, log_prob = rsample_and_log_prob(pi)
        cloned = self.alpha * log_prob - pi.log_prob(batch.a.unsqueeze(0))
        return losses | {"loss_actor_bc": self.reduce(cloned.mean(0), batch)}, metrics


def test_update_of_torchrls_script_runs_and_steps_on_every_term(batch) -> None:
    options, moved = {"num_random": 3, "target_action_gap": 1.0}, {}
    for start in (0, 5):
        loss = make_loss(WarmStart, **options)
        arguments = make_optimizer(loss), SoftUpdate(loss, tau=0.1), batch.clone()
        torch.manual_seed(2)
        script_update(loss, *arguments, torch.tensor(start), torch.tensor(3))
        moved[start] = [each.detach() for each in loss.parameters()]
    SoftUpdate(plain := make_loss(**options), tau=0.1)
    optimizer, slopes = make_optimizer(plain), gradients_of_all_losses(plain, batch)
    for each, slope in zip(plain.parameters(), slopes, strict=True):
        each.grad = slope
    optimizer.step()
    assert_same_bits(moved[0], [each.detach() for each in plain.parameters()])
    # In the first steps the policy alone takes another one.
    for (name, _), *pair in zip(plain.named_parameters(), *moved.values(), strict=True):
        assert torch.equal(*pair) != name.startswith("actor_network"), name


@pytest.mark.parametrize("gap", [None, 1.0])
def test_entries_are_torchrls_without_that_of_the_first_steps(gap) -> None:
    ours = make_loss(target_action_gap=gap)
    networks = tanh_gaussian_actor(3, 1, **BOUNDS), critic_ensemble(3, 1, num_cells=[8])
    theirs = CQLLoss(*networks, target_entropy=-1.0, with_lagrange=gap is not None)
    assert ours.with_lagrange == theirs.with_lagrange
    found, wanted = (
        {key for key in loss.out_keys if key.startswith("loss_")}
        for loss in (ours, theirs)
    )
    assert found == wanted - {"loss_actor_bc"}
