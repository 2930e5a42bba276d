"""OSR trained by TorchRL's CQLTrainer, configured by TorchRL's own Hydra options.

    python examples/torchrl_trainer.py env=walker2d loss.recovery_weight=1.0

The configuration is ``torchrl_trainer.yaml`` beside this file. Data are collected on
this machine and standardised. The inverse dynamics model is trained first, then the
policy, which finally plays its task. Writes ``result.json`` to Hydra's folder.
"""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import ProbabilisticTensorDictSequential
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
from torchrl_osr.lab.data.environment import environment_id
from torchrl_osr.lab.evaluation import EpisodeEvaluator, deterministic_policy, summarize
from torchrl_osr.trainers import ReplayBufferCollector

OmegaConf.register_new_resolver("frames", lambda steps, rows: steps * rows)


def load_buffer(cfg: DictConfig) -> tuple[ReplayBuffer, ObservationNorm]:
    """The data, standardised, in a buffer that adds perturbed states."""
    data, _ = load_dataset(
        cfg.env, cfg.data, num_transitions=cfg.num_transitions, progress=False
    )
    keys = ["observation", ("next", "observation")]
    norm = ObservationNorm(
        *observation_statistics(data), in_keys=keys, standard_normal=True
    )
    buffer = make_replay_buffer(
        norm(data),
        batch_size=cfg.batch_size,
        seed=cfg.seed,
        transform=instantiate(cfg.transform),
    )
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
    evaluator = EpisodeEvaluator(environment_id(cfg.env), num_episodes=cfg.episodes)
    result = summarize(
        evaluator(deterministic_policy(actor, norm)), reference_returns(cfg.env)
    )
    folder = Path(HydraConfig.get().runtime.output_dir)
    write_json(folder / "result.json", {"steps": cfg.steps, **result})
    print(f"score {result['score']:.1f}, return {result['return']:.0f}: {folder}")


if __name__ == "__main__":
    main()
