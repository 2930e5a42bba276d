"""What the tests of the trainer share: a small run of OSR, and its state."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from objectives.losses import make_loss
from torch.utils._pytree import tree_leaves
from torchrl.objectives import SoftUpdate

from torchrl_osr import StatePerturbation
from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data import make_replay_buffer
from torchrl_osr.trainers import Evaluation, OfflineTrainer


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


@pytest.fixture(scope="session")
def state() -> Callable[[OfflineTrainer], list[torch.Tensor]]:
    """Return a function: the tensors of a trainer's newest checkpoint."""
    return state_of_run


@pytest.fixture(scope="session")
def make(transitions):
    """Return a factory of trainers of 20 steps, which score 0, 1, 2 and so on.

    Two of them are the same run up to their folders.
    """

    def make(folder, **options) -> OfflineTrainer:
        loss = make_loss("osr").float()
        perturbation = StatePerturbation(0.1, seed=0)
        tracing = {name: options.pop(name, False) for name in ("trace", "warm_up")}
        scores = iter(range(1000))
        evaluate = options.pop("evaluate", lambda: {"score": next(scores), "raw": [1]})
        interval, best = options.pop("eval_interval", 5), options.pop("best", "max")
        options = {
            "total_steps": 20, "components": {"perturbation": perturbation},
            "evaluation": Evaluation(evaluate, interval, best=best),
            "checkpoint_interval": 5, "log_interval": 3, "progress": False,
        } | options  # fmt: skip
        buffer = make_replay_buffer(transitions(64), batch_size=8, seed=0)
        buffer.append_transform(perturbation)
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
        update = FastUpdate(loss, optimizer, SoftUpdate(loss, tau=0.1), **tracing)
        return OfflineTrainer(update, buffer, folder=folder, **options)

    return make


@pytest.fixture(scope="session")
def whole(make, tmp_path_factory) -> OfflineTrainer:
    """A run that nothing disturbs."""
    trainer = make(tmp_path_factory.mktemp("whole") / "undisturbed")
    trainer.train()
    return trainer


@pytest.fixture
def logger() -> SimpleNamespace:
    """Logger with ``numbers``: name, step and value of each."""
    rows = []
    return SimpleNamespace(
        numbers=rows,
        log_metrics=lambda of, step: rows.extend((n, step, v) for n, v in of.items()),
    )
