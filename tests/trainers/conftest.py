"""What the tests of the trainer share: a small run of OSR, and its state."""

from __future__ import annotations

import io
import zipfile
from types import SimpleNamespace

import pytest
import torch
from torch.utils._pytree import tree_leaves
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, OSRLoss, StatePerturbation
from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.modules import (
    critic_ensemble,
    tanh_gaussian_actor,
    tanh_gaussian_inverse_dynamics,
)
from torchrl_osr.trainers import Evaluation, OfflineTrainer


def inverse_dynamics_loss() -> InverseDynamicsLoss:
    torch.manual_seed(0)
    return InverseDynamicsLoss(tanh_gaussian_inverse_dynamics(3, 2), states="clean")


def osr_loss(cells: int = 8) -> OSRLoss:
    torch.manual_seed(0)
    each = {"num_cells": [cells]}
    critics = critic_ensemble(3, 2, **each)
    model = tanh_gaussian_inverse_dynamics(3, 2, **each)
    return OSRLoss(tanh_gaussian_actor(3, 2, **each), critics, model, num_random=2)


def state_of_run(trainer: OfflineTrainer) -> list[torch.Tensor]:
    """All tensors of the newest checkpoint: networks, optimizer, random generators."""
    tensors = []
    with zipfile.ZipFile(trainer.checkpoints.latest()) as archive:
        for name in sorted(archive.namelist()):
            if name.endswith("state.pt"):
                content = io.BytesIO(archive.read(name))
                state = torch.load(content, weights_only=True)
                # Nothing here seeds Python's and NumPy's generators.
                for other in ("python", "numpy"):
                    state.pop(other, None)
                tensors += filter(torch.is_tensor, tree_leaves(state))
    assert len(tensors) > 10
    return tensors


def assert_same_bits(mine, theirs) -> None:
    assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))


@pytest.fixture
def make(transitions):
    """Return a factory of trainers of 20 steps, which score 0, 1, 2 and so on.

    Two of them are the same run up to their folders.
    """

    def make(folder, *, cells=8, targets=True, **options) -> OfflineTrainer:
        loss, perturbation = osr_loss(cells), StatePerturbation(0.1, seed=0)
        updater = SoftUpdate(loss, tau=0.1)
        tracing = {name: options.pop(name, False) for name in ("trace", "warm_up")}
        scores = iter(range(1000))
        evaluate = options.pop("evaluate", lambda: {"score": next(scores), "raw": [1]})
        interval, best = options.pop("eval_interval", 5), options.pop("best", "max")
        options = {
            "total_steps": 20,
            "components": {"perturbation": perturbation},
            "evaluation": Evaluation(evaluate, interval, best=best),
            "checkpoint_interval": 5,
            "log_interval": 3,
            "progress": False,
        } | options
        buffer = make_replay_buffer(
            transitions(64), batch_size=8, seed=0, transform=perturbation
        )
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
        update = FastUpdate(loss, optimizer, updater if targets else None, **tracing)
        return OfflineTrainer(update, buffer, folder=folder, **options)

    return make


@pytest.fixture
def undisturbed(make, tmp_path) -> OfflineTrainer:
    """A whole run."""
    trainer = make(tmp_path / "undisturbed")
    trainer.train()
    return trainer


@pytest.fixture(scope="session")
def runs() -> SimpleNamespace:
    """Losses, and what compares runs."""
    return SimpleNamespace(
        osr_loss=osr_loss,
        inverse_dynamics_loss=inverse_dynamics_loss,
        state=state_of_run,
        assert_same_bits=assert_same_bits,
    )


@pytest.fixture
def logger() -> SimpleNamespace:
    """Logger with ``numbers``: name, step and value of each."""
    numbers = []
    return SimpleNamespace(
        numbers=numbers,
        log_scalar=lambda name, value, step: numbers.append((name, step, value)),
    )
