"""The conditional variational autoencoder of a run: its phase of training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_osr.lab.dynamics import ConditionalVAE, ConditionalVAELoss
from torchrl_osr.lab.run.training_data import ROWS_FOR_STATISTICS, TrainingData
from torchrl_osr.trainers import OfflineTrainer


def train_vae(
    model: ConditionalVAE,
    cfg: DictConfig,
    data: TrainingData,
    folder: Path,
    new_trainer: Callable[..., OfflineTrainer],
    adam: Callable[..., torch.optim.Optimizer],
) -> None:
    """Train a model on a run's rows for ``dynamics.vae_steps``, and freeze it.

    Args:
        model: as it was built.
        cfg: a whole configuration of ``torchrl-osr train``.
        data: what the run trains on.
        folder: of the run; the phase has checkpoints of its own.
        new_trainer: makes the trainer of a phase.
        adam: makes an optimizer from parameters.
    """
    options, held_out = cfg.dynamics, data.held_out
    model.to(held_out.device or "cpu")
    if model.change:
        rows = data.alone()
        rows.set_rng(torch.Generator(held_out.device or "cpu").manual_seed(cfg.seed))
        model.standardize_(rows.sample(ROWS_FOR_STATISTICS))
    loss = ConditionalVAELoss(model)

    @torch.no_grad()
    def evaluate() -> dict[str, float]:
        return {"vae_error": loss(held_out)["loss_vae"].item()}

    new_trainer(
        loss,
        adam(model.parameters(), lr=options.lr),
        replay_buffer=data.alone(options.batch_size),
        total_steps=options.vae_steps,
        folder=folder / "checkpoint" / "vae",
        seed=cfg.seed,
        evaluate=evaluate,
        metric=("vae_error", "min"),
        eval_interval=options.vae_steps,
        description="vae",
    ).train()
    model.requires_grad_(False)
