"""Continue the training of an OSR policy online, in its environment.

    torchrl-osr train env=hopper
    python examples/online_finetuning.py outputs/hopper-medium-replay/osr-seed0-... out/

TorchRL's OfflineToOnlineTrainer collects and mixes: half of every batch is the run's
data at first, none at the end. The loss is the run's own, with the inverse dynamics
model frozen and a perturbed state beside every state, recorded or new. Writes
``online.json`` and ``online.png``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torchrl.collectors import Collector
from torchrl.data import OfflineToOnlineReplayBuffer
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymWrapper,
    ObservationNorm,
    RewardScaling,
    TransformedEnv,
)
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import OfflineToOnlineTrainer

from torchrl_osr import OSRLoss, StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.lab.data import make_environment
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    deterministic_policy,
    measure_of,
    summarize,
)
from torchrl_osr.lab.evaluation.figures import IN_WORDS
from torchrl_osr.lab.run.config import check_environment
from torchrl_osr.lab.run.data import load_training_data, references_of
from torchrl_osr.lab.run.load import TrainedRun, load_trained

FRAMES_PER_BATCH = 100


def make_collector(run: TrainedRun, frames: int, seed: int) -> Collector:
    """Steps of the policy in its task, standardised as its data were."""
    norm = run.observation_norm
    environment = TransformedEnv(
        GymWrapper(make_environment(run.config.env.id)),
        Compose(
            DoubleToFloat(),
            ObservationNorm(
                norm.loc, norm.scale, in_keys=["observation"], standard_normal=True
            ),
            RewardScaling(run.config.data.reward_shift, run.config.data.reward_scale),
        ),
    )
    environment.set_seed(seed)
    return Collector(
        environment,
        run.loss.actor_network,
        frames_per_batch=FRAMES_PER_BATCH,
        total_frames=frames,
        auto_register_policy_transforms=True,
    )


def make_trainer(run: TrainedRun, frames: int, seed: int) -> OfflineToOnlineTrainer:
    """TorchRL's trainer with the run's data, loss and optimizer: one update a frame."""
    cfg, loss = run.config, run.loss
    cfg.optim.n_steps = 1  # as the rows that the environment will add
    buffer = OfflineToOnlineReplayBuffer(
        load_training_data(cfg).buffer,
        online_capacity=frames,
        offline_fraction=0.5,
        batch_size=cfg.trainer.batch_size,
        transform=StatePerturbation(cfg.perturbation.std, seed=seed),
    )
    critics = list(loss.qvalue_network_params.parameters())
    groups = [
        {"params": list(loss.actor_network_params.parameters())},
        {"params": list(loss.parameters(recurse=False))},  # log_alpha, for instance
        {"params": critics, "lr": cfg.optim.qvalue_lr},
    ]
    return OfflineToOnlineTrainer(
        collector=make_collector(run, frames, seed),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=FRAMES_PER_BATCH,
        loss_module=loss,
        optimizer=torch.optim.Adam(groups, lr=cfg.optim.actor_lr),
        replay_buffer=buffer,
        target_net_updater=SoftUpdate(loss, tau=cfg.optim.tau),
        enable_logging=False,
        progress_bar=False,
    )


def draw(record: dict, path: Path) -> None:
    """Draw the score with its interval over the environment's frames."""
    curve = record["curve"]
    frames = [point["frames"] for point in curve]
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    measure = measure_of(curve[0])
    low, high = (
        [point[f"{measure}_{end}"] for point in curve] for end in ("low", "high")
    )
    axes.fill_between(frames, low, high, alpha=0.2)
    axes.plot(frames, [point[measure] for point in curve], marker="o")
    axes.set(xlabel="environment frames after training from data")
    axes.set(ylabel=IN_WORDS[measure], title=f"{record['env']}, {record['loss']}")
    figure.savefig(path, dpi=120)


def main(arguments: Sequence[str]) -> None:
    """Go on with a run and write the curve after each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a run, or a checkpoint in it")
    parser.add_argument("output", type=Path, help="folder to write to")
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--interval", type=int, default=1000, help="of evaluations")
    parser.add_argument("--episodes", type=int, default=10, help="of an evaluation")
    parser.add_argument(
        "--min-q-weight", type=float, help="of CQL's term; default: the run's"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--trust", action="append", default=[], help="module that the run may import"
    )
    options = parser.parse_args(arguments)
    if options.interval % FRAMES_PER_BATCH or options.frames % options.interval:
        parser.error(
            f"--interval must be a multiple of {FRAMES_PER_BATCH}, --frames one of "
            "--interval."
        )

    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    run = load_trained(options.run, trust=options.trust)
    check_environment(run.config.env.id, options.trust)
    if not isinstance(run.loss, OSRLoss) or run.config.env.id is None:
        parser.error(
            f"{options.run} is no run of loss=osr or loss=osr_10 with a simulator."
        )
    if options.min_q_weight is not None:
        if not run.loss.has_cql:
            parser.error(f"{options.run} was trained without CQL's term.")
        run.loss.min_q_weight = options.min_q_weight
    options.output.mkdir(parents=True, exist_ok=True)
    record = {
        "env": run.config.env.name,
        "data": run.config.data.source,
        "loss": type(run.loss).__name__,
        "step": run.step,
        "min_q_weight": float(run.loss.min_q_weight),
        "seed": options.seed,
        "curve": [],
    }
    references = references_of(run.config.env)
    evaluator = EpisodeEvaluator(run.config.env.id, num_episodes=options.episodes)
    policy = deterministic_policy(run.actor, run.observation_norm)
    trainer = make_trainer(run, options.frames, options.seed)

    def evaluate() -> None:
        frames = trainer.collected_frames
        if frames % options.interval:
            return
        point = {"frames": frames, **summarize(evaluator(policy), references)}
        record["curve"].append(point)
        write_json(options.output / "online.json", record)
        draw(record, options.output / "online.png")
        measure = measure_of(point)
        print(f"{frames} frames: {measure} {point[measure]:.1f}", flush=True)

    evaluate()
    trainer.register_op("post_steps", evaluate)
    trainer.train()
    evaluator.close()


if __name__ == "__main__":
    main(sys.argv[1:])
