"""Train a policy with OSR on real MuJoCo transitions, from nothing, with one command.

    python examples/offline_osr.py env=hopper
    python examples/offline_osr.py env=walker2d data=medium-expert seed=3 preset=paper
    python examples/offline_osr.py -m env=hopper,walker2d seed=0,1,2 hydra/launcher=pool
    python examples/offline_osr.py resume=outputs/hopper-medium-replay/seed0-...
    python examples/offline_osr.py population=4 trainer.device=cuda

The data are rolled out on this machine at the first run and cached. A run leaves
``curve.png``, ``returns.json``, ``inverse_dynamics.json``, ``config.yaml``,
``status.json``, CSV files and ``checkpoint/`` in its folder.
"""

from __future__ import annotations

import os

# Threads that wait shall not spin; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.objectives import SoftUpdate

from torchrl_osr import InverseDynamicsLoss, StatePerturbation
from torchrl_osr.evaluation.episodes import (
    EpisodeEvaluator,
    deterministic_policy,
    summarize,
)
from torchrl_osr.evaluation.figures import learning_curve, read_scalars
from torchrl_osr.evaluation.inverse_dynamics import describe, inverse_dynamics_report
from torchrl_osr.evaluation.summary import score_table
from torchrl_osr.experiment import run_folder
from torchrl_osr.experiment import schema as config
from torchrl_osr.experiment.build import make_learner
from torchrl_osr.experiment.loggers import make_loggers
from torchrl_osr.experiment.training_data import load_training_data
from torchrl_osr.trainers import OfflineTrainer
from torchrl_osr.trainers.hardware import check_hardware
from torchrl_osr.trainers.members import Run, launch
from torchrl_osr.trainers.value_bounds import largest_value

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes
# Of both phases:
TRAINER_OPTIONS = (
    *("log_interval", "checkpoint_interval", "checkpoints_kept"),
    *("progress", "compile", "cudagraph", "nonfinite"),
)

config.register()


@hydra.main(version_base="1.3", config_path="../conf", config_name="offline_osr")
def main(cfg: DictConfig) -> float:
    """Run or resume a run or a population; return its last score, for a sweeper."""
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    if cfg.resume is not None:
        cfg = run_folder.saved_config(folder, job.overrides.task)
    return launch(cfg, folder, __file__, job.overrides.task, prepare_data, run)


def prepare_data(cfg: DictConfig) -> tuple[Any, ...]:
    """Set torch up and load the data: the same for every run of a population."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(cfg.trainer.num_threads)
    torch.set_float32_matmul_precision(cfg.trainer.matmul_precision)
    device, autocast = check_hardware(
        cfg.trainer.device, cfg.trainer.precision, cudagraph=cfg.trainer.cudagraph
    )
    if cfg.trainer.cudagraph and cfg.trainer.bc_steps:
        # A graph repeats one update; the loss would change on the way.
        raise ValueError("trainer.bc_steps must be 0 with trainer.cudagraph=true.")
    make_learner(cfg, 1, 1)  # a wrong option of the loss stops here, not after the data

    return device, autocast, load_training_data(cfg, device)


def run(cfg: DictConfig, folder: Path, shared: tuple[Any, ...]) -> Run:
    """Inverse dynamics model, policy, report; each trainer that is yielded is run."""
    device, autocast, data = shared
    torch.manual_seed(cfg.seed)
    perturbation = StatePerturbation(**cfg.perturbation, seed=cfg.seed)
    buffer = data.buffer(cfg.trainer.batch_size)
    buffer.append_transform(perturbation)
    training: dict[str, Any] = {
        "replay_buffer": buffer,
        "components": {"perturbation": perturbation, "observation_norm": data.norm},
        "loggers": make_loggers(folder=folder, **cfg.logger),
        "autocast_dtype": autocast,
    }
    # The configuration of an older run lacks some.
    training |= {key: cfg.trainer[key] for key in TRAINER_OPTIONS if key in cfg.trainer}

    # The policy's loss first: it holds the model that is trained next.
    sizes: tuple[int, int] = data.sizes
    actor, model, loss = make_learner(cfg, *sizes, device)

    # First phase: which action leads from s~ to s'?
    if hasattr(loss, "inverse_dynamics_network"):
        yield from train_inverse_dynamics(cfg, folder, model, data.held_out, training)

    # Second phase: the policy, taught by the critics and by the frozen model.
    critic_params = list(loss.qvalue_network_params.parameters())
    known = set(critic_params)
    policy_params = [each for each in loss.parameters() if each not in known]
    groups = [
        {"params": critic_params, "lr": cfg.optim.qvalue_lr},
        {"params": policy_params, "lr": cfg.optim.actor_lr},
    ]
    episodes = {"num_episodes": cfg.trainer.eval_episodes, "seed": EVALUATION_SEED}
    evaluator = EpisodeEvaluator(cfg.env.id, **episodes, device=device)
    policy = deterministic_policy(actor, data.norm)
    limit = largest_value(data.largest_reward, cfg.optim.gamma)
    trainer = OfflineTrainer(
        loss,
        torch.optim.Adam(groups, fused=True),
        total_steps=cfg.trainer.steps,
        folder=folder / "checkpoint" / "policy",
        seed=cfg.seed + 1,
        target_net_updater=SoftUpdate(loss, tau=cfg.optim.tau),
        evaluate=lambda: summarize(evaluator(policy), cfg.env.name),
        eval_interval=cfg.trainer.eval_interval,
        description="policy",
        bounds={"pred_value": limit, "target_value": limit},
        **training,
    )

    def warm_start(batch: TensorDict) -> TensorDict:
        loss.behavior_cloning = trainer.step <= cfg.trainer.bc_steps
        return batch

    if cfg.trainer.bc_steps:
        trainer.register_op("process_optim_batch", warm_start)
    yield trainer
    evaluator.close()
    return report(cfg, folder, data.score, trainer)


def train_inverse_dynamics(
    cfg: DictConfig,
    folder: Path,
    model: torch.nn.Module,
    held_out: TensorDict,
    training: dict[str, Any],
) -> Iterator[OfflineTrainer]:
    """Fit the model to the mixed data set and say how well it does on held-out rows."""
    loss = InverseDynamicsLoss(model, **cfg.inverse_dynamics.loss)
    rate = cfg.optim.inverse_dynamics_lr
    trainer = OfflineTrainer(
        loss,
        torch.optim.Adam(loss.parameters(), lr=rate, fused=True),
        total_steps=cfg.trainer.inverse_dynamics_steps,
        folder=folder / "checkpoint" / "inverse_dynamics",
        seed=cfg.seed,
        evaluate=lambda: inverse_dynamics_report(model, held_out),
        metric=("nll", "min"),
        eval_interval=cfg.trainer.inverse_dynamics_steps,
        description="inverse_dynamics",
        **training,
    )
    if cfg.inverse_dynamics.shuffle_next:
        trainer.register_op("process_optim_batch", shuffle_next)
    yield trainer
    run_folder.write_json(folder / "inverse_dynamics.json", trainer.history[-1])
    print(describe(trainer.history[-1]))


def shuffle_next(batch: TensorDict) -> TensorDict:
    """Give every row the next state of another: an ablation of the model."""
    key = ("next", "observation")
    return batch.set(key, batch[key].roll(1, 0))  # the rows came in random order


def report(
    cfg: DictConfig, folder: Path, data_score: float | None, trainer: OfflineTrainer
) -> float:
    """Write raw returns and the figure, print the table."""
    history, best = trainer.history, trainer.best()
    results = {
        "versions": run_folder.package_versions(),
        "data_score": data_score,
        "last": history[-1],
        "best": best,
    }
    run_folder.write_json(folder / "returns.json", results | {"evaluations": history})
    name = f"{cfg.env.name} {cfg.data.level}"
    learning_curve(
        history,
        read_scalars(folder / "csv" / "scalars" / "policy"),
        folder / "curve.png",
        title=f"{name}, seed {cfg.seed}, recovery weight {cfg.loss.recovery_weight:g}",
        data_score=data_score,
    )
    print("\n" + score_table(name, history, best, data_score, folder))
    return float(history[-1]["score"])


if __name__ == "__main__":
    main()
