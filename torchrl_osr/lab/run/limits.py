"""What the values of a configuration may be; their types are the schema's.

A wrong value stops here, by the name of its key, before data are made or memory is
taken.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from omegaconf import DictConfig

from torchrl_osr._checks import check_choice

LARGEST = 10**9
"""Largest magnitude of a number for which :data:`RANGES` has no other."""

# NumPy's seeds, torch's and Gymnasium's all go that far.
_SEED = (0, 2**32 - 1)
_COUNT = (1, LARGEST)
_WIDTH = (1, 2**16)

RANGES: dict[str, tuple[float, float]] = {
    "seed": _SEED,
    "data.seed": _SEED,
    "data.num_transitions": _COUNT,
    "data.random_share": (0, 1),
    "data.held_out": (0, 1),
    "data.reward_scale": (1e-9, LARGEST),
    "network.num_cells": _WIDTH,
    "inverse_dynamics.network.latent_dim": _WIDTH,
    "dynamics.num_networks": (1, 1000),
    "dynamics.num_elites": (1, 1000),
    "dynamics.num_cells": _WIDTH,
    "dynamics.lr": (0, LARGEST),
    "dynamics.batch_size": _COUNT,
    "dynamics.steps": _COUNT,
    "dynamics.vae_num_cells": _WIDTH,
    "dynamics.vae_steps": _COUNT,
    "dynamics.adversarial_steps": (0, LARGEST),
    "dynamics.adversarial_weight": (0, LARGEST),
    "dynamics.adversarial_lr": (0, LARGEST),
    "dynamics.rollout_steps": (1, 10_000),
    "dynamics.rollout_starts": _COUNT,
    "dynamics.perturbed_start_steps": (0, 10_000),
    "dynamics.action_noise": (0, LARGEST),
    "dynamics.rollout_interval": _COUNT,
    "dynamics.generations": (1, 1000),
    "dynamics.real_ratio": (0, 1),
    "dynamics.penalty": (0, LARGEST),
    "dynamics.known_share": (0, 1),
    "perturbation.std": (0, LARGEST),
    "perturbation.adversary.num_samples": (1, 10_000),
    "perturbation.adversary.num_steps": (1, 10_000),
    "loss.num_qvalue_nets": (1, 1000),
    "loss.num_random": (1, 10_000),
    "loss.num_samples": (1, 10_000),
    "loss.clip_diff_min": (-math.inf, LARGEST),
    "optim.actor_lr": (0, LARGEST),
    "optim.qvalue_lr": (0, LARGEST),
    "optim.inverse_dynamics_lr": (0, LARGEST),
    "optim.gamma": (0, 1),
    "optim.n_steps": (1, 1000),
    "optim.tau": (0, 1),
    "optim.policy_delay": (1, 1000),
    "optim.policy_average": (0, 1),
    "trainer.batch_size": _COUNT,
    "trainer.inverse_dynamics_steps": _COUNT,
    "trainer.steps": _COUNT,
    "trainer.log_interval": _COUNT,
    "trainer.eval_interval": _COUNT,
    "trainer.eval_episodes": (1, 10_000),
    "trainer.checkpoint_interval": _COUNT,
    "trainer.checkpoints_kept": _COUNT,
    "trainer.num_threads": (1, 1024),
    "episodes": (1, 10_000),
    "last": _COUNT,
    "knock": (1, 10_000),
    "after": (2, 1_000_000),
    "num_threads": (1, 1024),
}
"""Lowest and highest number of a key; of a list, of each of its entries."""

_REDUCTIONS = (None, "mean", "sum")  # a trainer goes backward from one number

CHOICES: dict[str, tuple[str | None, ...]] = {
    "data.storage": ("memory", "disk"),
    "dynamics.terminations": ("auto", "never"),
    "dynamics.unknown": ("refuse", "halt", "take"),
    "dynamics.reverse_policy": (None, "cvae", "uniform"),
    "perturbation.noise": ("gaussian", "uniform"),
    "inverse_dynamics.loss.reduction": _REDUCTIONS,
    "loss.reduction": _REDUCTIONS,
    "recovery.reduction": _REDUCTIONS,
    "optim.actor_schedule": ("constant", "cosine"),
    "optim.qvalue_schedule": ("constant", "cosine"),
    "trainer.precision": ("float32", "bfloat16"),
    "trainer.matmul_precision": ("highest", "high", "medium"),
    "logger.kind": ("csv", "tensorboard", "wandb"),
    "logger.mode": ("offline", "online", "disabled"),
    "suite.half": (None, "public", "held-out"),
}
"""Words that a key may have as its value."""

PATTERNS = {
    "trainer.device": (r"cpu|cuda(:\d+)?", "cpu, cuda or cuda:<number>"),
    "suite.name": (r"[\w.-]+", "a part of a file's name"),
}
"""What the value of a key must match, and in words."""


def check_values(values: Mapping[str, Any]) -> None:
    """Raise a ValueError that names the key unless every value is one that it may have.

    Numbers are finite and in :data:`RANGES`, words in :data:`CHOICES` or as in
    :data:`PATTERNS`.

    Args:
        values: by dotted key, see :func:`~torchrl_osr.lab.run.run_config.flatten`.

    Examples:
        >>> from torchrl_osr.lab.run.limits import check_values
        >>> check_values({"optim.gamma": 1.5})
        Traceback (most recent call last):
            ...
        ValueError: optim.gamma must be between 0 and 1, got 1.5.
    """
    for key, value in values.items():
        lowest, highest = RANGES.get(key, (-LARGEST, LARGEST))
        for each in value if isinstance(value, list) else [value]:
            # Not "each < lowest": nan is neither.
            if isinstance(each, (int, float)) and not lowest <= each <= highest:
                raise ValueError(
                    f"{key} must be between {lowest:,} and {highest:,}, got {each}."
                )
        if key in CHOICES:
            check_choice(key, value, CHOICES[key])
        pattern, meaning = PATTERNS.get(key, ("", ""))
        if pattern and not re.fullmatch(pattern, value):
            raise ValueError(f"{key} must be {meaning}, got {value!r}.")


def check_networks(
    config: DictConfig,
    observation_size: int,
    action_size: int,
    device: torch.device | str = "cpu",
    *,
    training: bool = False,
) -> None:
    """Raise a ValueError if a run's networks need more memory than there is.

    Counted are the parameters of actor, critics, target networks and inverse dynamics
    model, all as multilayer perceptrons of ``network.num_cells``.

    Args:
        config: a whole configuration of ``torchrl-osr train``.
        observation_size, action_size: of the data.
        device: where the networks shall be. Default CPU.

    Keyword Args:
        training: count also gradients, Adam's two moments and a batch's activations.
            Default ``False``.
    """
    widths = [observation_size + action_size, *config.network.num_cells, 1]
    parameters = sum((inputs + 1) * outputs for inputs, outputs in pairwise(widths))
    critics = int(config.loss.get("num_qvalue_nets", 2))
    numbers = (2 * critics + 2) * parameters
    if training:
        batch = config.trainer.batch_size * critics * sum(widths)
        numbers += 3 * (critics + 2) * parameters + batch
    device = torch.device(device)
    if device.type == "cuda":
        memory = torch.cuda.mem_get_info(device)[1]
    else:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if (needed := 4 * numbers) > memory:  # float32
        raise ValueError(
            f"network.num_cells={list(config.network.num_cells)}, "
            f"loss.num_qvalue_nets={critics} and "
            f"trainer.batch_size={config.trainer.batch_size} need {needed / 1e9:,.0f} "
            f"GB ({parameters:,} parameters a network), and the memory has "
            f"{memory / 1e9:,.0f} GB: choose smaller ones."
        )
