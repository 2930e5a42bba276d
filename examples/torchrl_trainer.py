"""OSR trained by TorchRL's CQLTrainer, configured by TorchRL's own Hydra options.

    python examples/torchrl_trainer.py data=medium loss.recovery_weight=1.0

The configuration is ``torchrl_trainer.yaml`` beside this file. Its networks have the
sizes of a Hopper. Unlike the quick preset, it has one-step returns, no average of the
weights, and other rates and batches. Data are collected here and standardised. The
model is trained first, then the policy, which plays its task. Writes ``result.json``.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer
from torchrl.envs import ObservationNorm
from torchrl.trainers import DefaultOptimizationStepper, Trainer
from torchrl.trainers.algorithms import configs  # noqa: F401 (TorchRL's options)

from torchrl_osr import InverseDynamicsLoss
from torchrl_osr._files import write_json
from torchrl_osr.lab.data import (
    load_dataset,
    make_replay_buffer,
    observation_statistics,
    reference_returns,
)
from torchrl_osr.lab.data.environment import known_ids
from torchrl_osr.lab.evaluation import EpisodeEvaluator, deterministic_policy, summarize

OmegaConf.register_new_resolver(
    "frames", lambda steps, rows: steps * rows, replace=True
)


class ReplayBufferCollector(BaseCollector):
    """The batches of a replay buffer, as a collector's frames.

    TorchRL 0.14.1's trainers take every frame from an environment. With this collector
    they train on recorded data alone: every batch is one ``replay_buffer.sample()``,
    and ``total_frames`` count its rows. Such a trainer gets ``optim_steps_per_batch=1``
    and no ``replay_buffer`` of its own.
    """

    init_random_frames = 0

    def __init__(self, replay_buffer: ReplayBuffer, *, total_frames: int) -> None:
        super().__init__()
        self.replay_buffer = replay_buffer
        self.total_frames = total_frames
        self._frames = 0
        self._generator: torch.Generator | None = None

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[B]`` until ``total_frames`` rows were drawn."""
        while self._frames < self.total_frames:
            batch = self.replay_buffer.sample()
            self._frames += len(batch)
            yield batch

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the draws; return the seed."""
        device = self.replay_buffer.storage.device  # where the draws are made
        self._generator = torch.Generator(device).manual_seed(seed)
        self.replay_buffer.set_rng(self._generator)
        return seed

    def update_policy_weights_(self, *_: Any, **__: Any) -> None:
        """Do nothing: no policy acts here."""

    def shutdown(self, *_: Any, **__: Any) -> None:
        """Do nothing: no environment runs."""

    def state_dict(self) -> OrderedDict[str, Any]:
        """Return the number of rows that were drawn and, once seeded, the draws."""
        state: OrderedDict[str, Any] = OrderedDict(frames=self._frames)
        if self._generator is not None:
            state["generator"] = self._generator.get_state()
        return state

    def load_state_dict(self, state_dict: OrderedDict[str, Any]) -> None:
        """Continue after the saved rows; if seeded, call :meth:`set_seed` first."""
        self._frames = int(state_dict["frames"])
        if self._generator is not None and "generator" in state_dict:
            self._generator.set_state(state_dict["generator"])


def load_buffer(cfg: DictConfig) -> tuple[ReplayBuffer, ObservationNorm]:
    """The data, standardised, in a buffer that adds perturbed states."""
    data, _ = load_dataset(
        cfg.env, cfg.data, num_transitions=cfg.num_transitions, progress=False
    )
    keys = ["observation", ("next", "observation")]
    norm = ObservationNorm(
        *observation_statistics(data), in_keys=keys, standard_normal=True
    )
    rows, size = norm(data), cfg.batch_size
    buffer = make_replay_buffer(rows, batch_size=size, seed=cfg.seed)
    buffer.append_transform(instantiate(cfg.transform))
    return buffer, norm


def train_inverse_dynamics(
    cfg: DictConfig, buffer: ReplayBuffer
) -> ProbabilisticTensorDictSequential:
    """Learn which action leads from a state to the next, with TorchRL's Trainer."""
    model = instantiate(cfg.inverse_dynamics)
    loss = InverseDynamicsLoss(model)
    frames = cfg.inverse_dynamics_steps * cfg.batch_size
    Trainer(
        collector=ReplayBufferCollector(buffer, total_frames=frames),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=instantiate(cfg.optimizer)(params=loss.parameters()),
        optimization_stepper=DefaultOptimizationStepper(),
        progress_bar=cfg.trainer.progress_bar,
    ).train()
    return model


@hydra.main(version_base="1.3", config_path=".", config_name="torchrl_trainer")
def main(cfg: DictConfig) -> None:
    """Train on recorded data and play the policy."""
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.num_threads)
    buffer, norm = load_buffer(cfg)
    model = train_inverse_dynamics(cfg, buffer)
    actor = instantiate(cfg.actor)
    loss = instantiate(cfg.loss)(actor, instantiate(cfg.critics), model)
    loss.make_value_estimator(gamma=cfg.gamma)
    frames = cfg.trainer.total_frames
    trainer = instantiate(cfg.trainer, _partial_=True)(
        collector=ReplayBufferCollector(buffer, total_frames=frames),
        loss_module=loss,
        optimizer=instantiate(cfg.optimizer),
        target_net_updater=instantiate(cfg.target_net_updater),
    )
    trainer.train()
    evaluator = EpisodeEvaluator(known_ids()[cfg.env], num_episodes=cfg.episodes)
    result = summarize(
        evaluator(deterministic_policy(actor, norm)), reference_returns(cfg.env)
    )
    folder = Path(HydraConfig.get().runtime.output_dir)
    write_json(folder / "result.json", {"steps": cfg.steps, **result})
    print(f"score {result['score']:.1f}, return {result['return']:.0f}: {folder}")


if __name__ == "__main__":
    main()
