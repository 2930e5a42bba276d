"""TorchRL's own trainer trains every term of the losses.

Its CQLTrainer steps on the entries whose names it knows: a term in an entry of another
name would be lost without an error.
"""

from __future__ import annotations

import pytest
import torch
from objectives.losses import assert_same_bits
from torch.optim import Adam
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import CQLTrainer

from torchrl_osr import OSRLoss, OSRVLoss, StatePerturbation, modules

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


def make_loss(loss_class: type, **options):
    """Return a loss for Pendulum; equal weights at each call."""
    torch.manual_seed(0)
    return loss_class(
        modules.tanh_gaussian_actor(3, 1, **BOUNDS),
        modules.critic_ensemble(3, 1, num_cells=[8]),
        modules.tanh_gaussian_inverse_dynamics(3, 1, **BOUNDS),
        **options,
    )


def make_trainer(loss, optimizer) -> CQLTrainer:
    environment = GymEnv("Pendulum-v1")
    environment.set_seed(0)
    collector = Collector(
        environment, loss.actor_network, frames_per_batch=32, total_frames=64,
        auto_register_policy_transforms=True,
    )  # fmt: skip
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(64), batch_size=16)
    buffer.append_transform(StatePerturbation(std=0.1))
    return CQLTrainer(
        collector=collector, total_frames=64, frame_skip=1, optim_steps_per_batch=3,
        loss_module=loss, optimizer=optimizer, replay_buffer=buffer,
        target_net_updater=SoftUpdate(loss, tau=0.1), progress_bar=False,
        enable_logging=False,
    )  # fmt: skip


@pytest.mark.parametrize("kind", LOSSES)
def test_cql_trainer_steps_along_the_gradient_of_all_losses(transitions, kind) -> None:
    batch = StatePerturbation(std=0.1)(transitions(16, action=1))
    loss_class, options = LOSSES[kind]
    loss = make_loss(loss_class, **options)
    SoftUpdate(reference := make_loss(loss_class, **options), tau=0.1)
    torch.manual_seed(2)
    out = reference(batch.clone())
    total = sum(out[key] for key in out.keys() if key.startswith("loss_"))  # noqa: SIM118
    expected = [*torch.autograd.grad(total, [*reference.parameters()])]
    optimizer, stepped = Adam(loss.parameters(), lr=1e-2), []
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
