"""Parts of a training run, for ``torchrl-osr train`` and examples/offline_osr.py."""

from __future__ import annotations

import logging
import math
import uuid
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel
from torchrl import torchrl_logger
from torchrl.envs import ObservationNorm
from torchrl.record.loggers import CSVLogger, Logger, get_logger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_osr._extras import needed_by
from torchrl_osr._files import write_atomically, write_json
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    deterministic_policy,
    summarize,
)
from torchrl_osr.lab.evaluation.figures import learning_curve, read_scalars
from torchrl_osr.lab.evaluation.tables import score_table
from torchrl_osr.lab.run.build import Learner
from torchrl_osr.lab.run.data import references_of
from torchrl_osr.lab.run.folder import Run, package_versions
from torchrl_osr.lab.run.load import CHECKPOINTS, POLICY, policy_of, restore
from torchrl_osr.trainers import Evaluation, OfflineTrainer

log = logging.getLogger(__name__)

adam = partial(torch.optim.Adam, fused=True)

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes


def prepare_machine(run: Run) -> tuple[torch.device, torch.dtype | None]:
    """Log what is trained where, and set torch's threads; device and autocast type."""
    config, options = run.config, run.config.trainer
    torchrl_logger.setLevel("WARNING")
    name = f"{config.env.name} {config.data.source}, seed {config.seed}"
    versions = ", ".join(f"{name} {each}" for name, each in package_versions().items())
    log.info(f"{name}, in {run.folder}\n{versions}")
    torch.set_num_threads(options.num_threads)
    torch.set_float32_matmul_precision(options.matmul_precision)
    autocast = torch.bfloat16 if options.precision == "bfloat16" else None
    return torch.device(options.device), autocast


def make_loggers(run: Run) -> list[Logger]:
    """Make the CSV logger, which figures are drawn from, and the chosen one.

    A continued run continues its W&B run.
    """
    config, folder, kind = run.config, run.folder, run.config.logger.kind
    loggers: list[Logger] = [CSVLogger("csv", log_dir=str(folder))]
    if kind == "csv":
        return loggers
    with needed_by(f"logger={kind} needs", "wandb" if kind == "wandb" else "train"):
        import_module(kind)
    name, options = kind, {}
    if kind == "wandb":
        if not (known := folder / ".wandb_id").exists():
            write_atomically(known, uuid.uuid4().hex)
        group = f"{config.env.name}-{config.data.source} {run.method}"
        name = f"{group} seed{config.seed}"
        options = {
            "id": known.read_text(),
            "project": config.logger.project,
            "mode": config.logger.mode,
            # A sweep's jobs may share a process, and a failed one left its run open.
            "reinit": "finish_previous",
            "group": group,
            "config": asdict(config) | {"versions": package_versions()},
        }
    return [*loggers, get_logger(kind, str(folder), name, wandb_kwargs=options)]


def trainer_options(run: Run) -> dict[str, Any]:
    """Return the options that the trainers of all phases share, loggers among them."""
    names = "log_interval", "checkpoint_interval", "checkpoints_kept", "progress"
    options = {name: getattr(run.config.trainer, name) for name in names}
    return options | {"loggers": make_loggers(run)}


def optimizer_of(
    run: Run, critics: Sequence[Parameter], policy: Sequence[Parameter]
) -> tuple[torch.optim.Optimizer, LambdaLR]:
    """Return Adam with a learning rate and a schedule for critics and policy each."""
    optim, total = run.config.optim, run.config.trainer.steps

    def cosine(step: int) -> float:
        return 0.5 * (1 + math.cos(math.pi * min(step / total, 1)))

    factors = {"cosine": cosine, "constant": lambda _: 1.0}
    groups, schedules = [], []
    for params, rate, schedule in (
        (critics, optim.qvalue_lr, "constant"),
        (policy, optim.actor_lr, optim.actor_schedule),
    ):
        if params:
            groups.append({"params": params, "lr": rate})
            schedules.append(factors[schedule])
    optimizer = adam(groups)
    return optimizer, LambdaLR(optimizer, schedules)


def averaged(network: torch.nn.Module, share: float) -> AveragedModel:
    """Return an exponential average of a network's weights; it is evaluated.

    ``share`` is that of the new weights at each update. The first weights would stay in
    the average for longer than a short run lasts: until update number ``10 / share`` it
    covers about the last tenth of all updates.
    """

    @torch.no_grad()
    def move(average: Any, weights: Any, count: Tensor | int) -> None:
        torch._foreach_lerp_(average, weights, max(share, 10 / (int(count) + 10)))

    return AveragedModel(network, multi_avg_fn=move)


@contextmanager
def evaluation(
    run: Run, norm: ObservationNorm, average: AveragedModel
) -> Iterator[Evaluation | None]:
    """Open the episodes that evaluate the averaged policy; ``None``: no simulator."""
    if not run.simulated:
        yield None
        return
    references = references_of(run.config.env)
    episodes = EpisodeEvaluator(
        run.config.env.id,
        num_episodes=run.config.trainer.eval_episodes,
        seed=EVALUATION_SEED,
        device=run.config.trainer.device,
    )

    def evaluate() -> dict[str, Any]:
        policy = deterministic_policy(average.module, norm)
        return summarize(episodes(policy), references)

    measure = "return" if references is None else "score"
    with closing(episodes):
        yield Evaluation(evaluate, run.config.trainer.eval_interval, measure)


def save_policies(run: Run, learner: Learner, norm: ObservationNorm) -> None:
    """Export the last policy and the best one, for ``torchrl_osr.load_policy``."""
    best = run.folder / CHECKPOINTS / "best.torchrl"
    newest = max((run.folder / CHECKPOINTS).glob("checkpoint-*.torchrl"))
    places = {best: best.with_suffix(".safetensors"), newest: run.folder / POLICY}
    for checkpoint, place in places.items():
        if not checkpoint.exists():  # best: without a simulator
            continue
        try:
            policy_of(restore(checkpoint, run.config, learner, norm)).save(place)
        except ValueError as error:  # networks of the user's own
            log.warning(f"The policy is not exported: {error}")
            return


def report(run: Run, data_mean: float | None, trainer: OfflineTrainer) -> float:
    """Write raw returns and the figure, print the table; return the last score.

    Without a simulator there are no evaluations, and the score is NaN.
    """
    config, folder = run.config, run.folder
    history = trainer.history
    measure = "return" if references_of(config.env) is None else "score"
    rows: dict[str, Any] = {}
    if history:
        rows = {"last": history[-1], "best": trainer.best() or history[0]}
    results = {"versions": package_versions(), f"data_{measure}": data_mean, **rows}
    write_json(folder / "returns.json", results | {"evaluations": history})
    name = f"{config.env.name} {config.data.source}"
    learning_curve(
        history,
        read_scalars(folder / "csv" / "scalars" / "policy"),
        folder / "curve.png",
        title=f"{name}, {run.method}, seed {config.seed}",
        data_mean=data_mean,
    )
    for logger in trainer.loggers:
        if isinstance(logger, WandbLogger):
            import wandb

            logger.experiment.log({"curve": wandb.Image(str(folder / "curve.png"))})
            logger.experiment.finish()
    if not history:
        print(f"\n{name}, in {folder}: {config.env.id} has no simulator to play in")
        return math.nan
    print("\n" + score_table(name, history, rows["best"], data_mean, folder))
    return float(history[-1][measure])
