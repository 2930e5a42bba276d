"""What a run trains on: rows in memory, prepared once, or on disk, batch by batch.

Observations are standardised and rewards scaled by the same transform, applied to all
rows in memory or to each batch from disk: the same seed gives the same batches.

Shapes: ``S`` observation, ``A`` action.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, ObservationNorm, RewardScaling

from torchrl_osr.lab.data import make_replay_buffer, observation_statistics
from torchrl_osr.lab.data.rows import (
    check_order,
    consecutive_rows,
    held_out_rows,
    multi_step,
    next_action,
    split_held_out,
)
from torchrl_osr.lab.dynamics import ModelData
from torchrl_osr.lab.run.build import check_storage, load_data, references_of

MAX_HELD_OUT = 50_000
"""Held-out rows of a set on disk that are read into memory, at most."""

NUM_PIECES, PIECE = 500, 20
"""Pieces of trajectories to judge a dynamics model by, at most, and their rows."""


class TrainingData(NamedTuple):
    """The rows to train on and to judge by, prepared and on the device.

    Attributes:
        buffer: samples ``trainer.batch_size`` rows; the trainer seeds it.
        held_out: rows that are not in the buffer.
        norm: what standardises observations.
        largest_reward: the largest absolute reward, held-out rows included.
        mean: score of the behaviour, or return where there are no scores, if known.
        pieces: of trajectories, each from a held-out row on, ``[n, 20]``; the rows that
            follow may be trained on. ``None`` if there is no dynamics model.
    """

    buffer: ReplayBuffer
    held_out: TensorDict
    norm: ObservationNorm
    largest_reward: float
    mean: float | None
    pieces: TensorDict | None


def model_data(cfg: DictConfig, data: TrainingData) -> ModelData:
    """Return a run's data as models of the dynamics learn from them."""
    return ModelData(
        data.buffer.storage,
        data.held_out,
        data.pieces,
        data.norm.loc,
        data.norm.scale,
        cfg.data.reward_scale,
        cfg.data.reward_shift,
        cfg.env.id,
    )


def load_training_data(
    cfg: DictConfig, device: torch.device, in_keys: Sequence[NestedKey] = ()
) -> TrainingData:
    """Load a run's data, split and prepared, see ``data`` of its configuration.

    Rewards become ``data.reward_scale * r + data.reward_shift``; the mean is of the
    task's own.

    Args:
        cfg: a whole configuration of ``torchrl-osr train``.
        device: where batches and networks are.
        in_keys: what the loss reads: with ``("next", "action")`` among it batches have
            the data's next action. Default: what every data set has.

    Raises:
        ValueError: an option cannot be had with the others, or the loss reads the next
            action and the rows are in no order of time.
        MemoryError: the data do not fit into the GPU.
    """
    on_disk = check_storage(cfg) == "disk"
    data, manifest = load_data(cfg, progress=cfg.trainer.progress)
    if with_next_action := ("next", "action") in in_keys:
        try:
            check_order(data)
        except ValueError as error:
            raise ValueError(
                f"{cfg.loss._target_} reads the data's next action, and "
                f"data={cfg.data.source} with data.path={cfg.data.path} and "
                f"data.random_share={cfg.data.random_share} does not tell it: {error}"
            ) from error
    loc, scale = observation_statistics(data) if cfg.data.standardize else (0.0, 1.0)
    factor, addend = cfg.data.reward_scale, cfg.data.reward_shift
    extremes = torch.stack(data["next", "reward"].aminmax())
    largest = (factor * extremes + addend).abs().max().item()

    def norm(*keys: NestedKey) -> ObservationNorm:  # one belongs to one Compose
        return ObservationNorm(loc, scale, in_keys=list(keys), standard_normal=True)

    states = "observation", ("next", "observation")
    prepare = Compose(norm(*states))
    if (factor, addend) != (1.0, 0.0):
        prepare.append(RewardScaling(addend, factor, in_keys=[("next", "reward")]))
    prepare_steps = norm("observation")

    def read(data: TensorDictBase, rows: Tensor | None = None) -> TensorDictBase:
        batch = data.copy() if rows is None else data[rows]
        if with_next_action:
            batch["next", "action"] = next_action(data, rows)
        batch = prepare(batch)
        if cfg.optim.n_steps > 1:
            steps = multi_step(
                data,
                rows,
                n_steps=cfg.optim.n_steps,
                gamma=cfg.optim.gamma,
                reward_scale=factor,
                reward_shift=addend,
                with_next_action=with_next_action,
            )
            batch["multi_step"] = prepare_steps(steps)
        return batch

    options = {"batch_size": cfg.trainer.batch_size, "seed": 0, "device": device}
    share, seed = cfg.data.held_out, cfg.data.seed
    chosen = held_out_rows(len(data), share, seed=seed)
    pieces = None
    if cfg.dynamics.use:
        pieces = prepare(consecutive_rows(data, chosen[:NUM_PIECES], PIECE)).to(device)
    if on_disk:
        held_out = read(data, chosen[:MAX_HELD_OUT].sort().values)
        left_out = chosen.sort().values
        buffer = make_replay_buffer(data, left_out=left_out, read=read, **options)
    else:  # what follows a row, before some are held out
        rows, held_out = split_held_out(read(data), share, seed=seed)
        buffer = make_replay_buffer(rows, **options)
    mean = manifest["normalized_score"]
    if references_of(cfg) is None:
        mean = (manifest.get("return") or {}).get("mean")
    return TrainingData(
        buffer, held_out.to(device), norm(*states).to(device), largest, mean, pieces
    )
