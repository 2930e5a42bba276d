"""TorchRL's own training code, unmodified, trains every term of the losses.

Its CQLTrainer steps on the entries whose names it knows and its scripts build an
optimizer for each group of parameters: a term in an entry of another name, or a group
that nobody lists, would be lost without an error.
"""

from __future__ import annotations

import pytest
import torch
from torch.optim import Adam
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.objectives import SoftUpdate
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
    "osr-lagrange": (OSRLoss, {"num_random": 3, "with_lagrange": True}),
    "osrv": (OSRVLoss, {}),
}
pytestmark = [
    # Raised by TorchRL 0.14.1's trainer about itself.
    pytest.mark.filterwarnings("ignore:CQLTrainer is an experimental:UserWarning"),
    pytest.mark.filterwarnings("ignore:The 'post_loss' hook stage:FutureWarning"),
    pytest.mark.parametrize("kind", LOSSES),
]


def make_loss(kind: str, recovery_weight: float = 0.5):
    """A loss for Pendulum; equal weights at each call."""
    torch.manual_seed(0)
    loss_class, options = LOSSES[kind]
    return loss_class(
        tanh_gaussian_actor(3, 1, **BOUNDS),
        critic_ensemble(3, 1, num_cells=[8]),
        tanh_gaussian_inverse_dynamics(3, 1, **BOUNDS),
        recovery_weight=recovery_weight,
        **options,
    )


def split_optimizer(loss) -> Adam:
    """One optimizer for each group of parameters, as in TorchRL's scripts."""
    optimizers = [
        Adam(list(loss.actor_network_params.flatten_keys().values()), lr=1e-2),
        Adam(list(loss.qvalue_network_params.flatten_keys().values()), lr=1e-2),
        Adam([loss.log_alpha], lr=1e-2),
    ]
    if getattr(loss, "with_lagrange", False):
        optimizers.append(Adam([loss.log_alpha_prime], lr=1e-2))
    return group_optimizers(*optimizers)


def make_trainer(loss, optimizer) -> CQLTrainer:
    environment = GymEnv("Pendulum-v1")
    environment.set_seed(0)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(64),
        batch_size=16,
        transform=StatePerturbation(std=0.1),
    )
    return CQLTrainer(
        collector=Collector(
            environment,
            loss.actor_network,
            frames_per_batch=32,
            total_frames=64,
            auto_register_policy_transforms=True,
        ),
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


def pendulum(make_batch):
    """A batch of random transitions with actions of one dimension."""
    batch = make_batch(16, twin=False).float()
    batch["action"] = batch["action"][:, :1]
    for key in ("done", "terminated"):
        batch["next", key] = batch["next", key].bool()
    return StatePerturbation(std=0.1)(batch)


def gradients_of_all_losses(loss, batch) -> list[torch.Tensor]:
    """Of the sum of every ``loss_*`` entry, by the loss's parameters."""
    torch.manual_seed(2)
    out = loss(batch)
    total = sum(out[key] for key in out.keys() if key.startswith("loss_"))  # noqa: SIM118
    return list(torch.autograd.grad(total, list(loss.parameters())))


@pytest.mark.parametrize("split", [True, False], ids=["split", "joint"])
def test_cql_trainer_steps_along_the_gradient_of_all_losses(
    make_batch, assert_same_bits, kind, split
) -> None:
    loss, batch = make_loss(kind), pendulum(make_batch)
    SoftUpdate(reference := make_loss(kind), tau=0.1)
    expected = gradients_of_all_losses(reference, batch.clone())
    optimizer = split_optimizer(loss) if split else Adam(loss.parameters(), lr=1e-2)
    trainer, stepped = make_trainer(loss, optimizer), []
    optimizer.register_step_pre_hook(
        lambda *_: stepped.extend(each.grad.clone() for each in loss.parameters())
    )
    before = [parameter.detach().clone() for parameter in loss.parameters()]
    torch.manual_seed(2)
    trainer.optimization_stepper.step(trainer, batch)
    assert_same_bits(stepped, expected)
    for old, parameter in zip(before, loss.parameters(), strict=True):
        assert not torch.equal(old, parameter)
    trainer.collector.shutdown()


def test_cql_trainer_trains_the_recovery_term(assert_same_bits, kind) -> None:
    policies, critics = [], []
    for weight in (0.5, 50.0, 0.5):
        loss = make_loss(kind, recovery_weight=weight)
        torch.manual_seed(1)
        trainer = make_trainer(loss, split_optimizer(loss))
        trainer.train()
        assert trainer._optim_count == 6
        policies.append(list(loss.actor_network_params.parameters()))
        critics.append(list(loss.qvalue_network_params.parameters()))
    trained = critics if kind == "osrv" else policies
    weak, strong, again = trained
    assert_same_bits(again, weak)
    assert all(not torch.equal(*pair) for pair in zip(weak, strong, strict=True))
