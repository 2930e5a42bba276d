"""Train a policy with OSR on offline data, with one command.

    torchrl-osr train env=hopper
    torchrl-osr train env.id=Pendulum-v1 data=file data.path=log.npz
    torchrl-osr train env=walker2d data=medium-expert seed=3 preset=paper
    torchrl-osr train -m env=hopper,walker2d seed=0,1,2 hydra/launcher=pool
    torchrl-osr train resume=<folder of a run> trainer.steps=40_000

Data of the built-in tasks are rolled out on this machine at the first run and cached;
docs/any_environment.md is about all others. A run leaves
``curve.png``, ``returns.json``, ``inverse_dynamics.json``, ``config.yaml``,
``status.json``, CSV files and ``checkpoint/`` in its folder.
"""

from __future__ import annotations

import logging
import math
import sys
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger
from torchrl.record.loggers import Logger

from torchrl_osr import StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.lab.cli import CONF
from torchrl_osr.lab.cli.console import single_job
from torchrl_osr.lab.data import environment_spec
from torchrl_osr.lab.dynamics.training import FILE as DYNAMICS
from torchrl_osr.lab.dynamics.training import load_dynamics
from torchrl_osr.lab.evaluation.figures import learning_curve
from torchrl_osr.lab.evaluation.training_summary import read_scalars, score_table
from torchrl_osr.lab.run import run_folder, schema
from torchrl_osr.lab.run.build import (
    check_parts,
    make_learner,
    read_environment,
    references_of,
)
from torchrl_osr.lab.run.loggers import log_outcome, make_loggers
from torchrl_osr.lab.run.phases import (
    train_dynamics,
    train_inverse_dynamics,
    train_policy,
    trainer_maker,
)
from torchrl_osr.lab.run.published import check_published
from torchrl_osr.lab.run.run_config import check_run, module_of, read_yaml
from torchrl_osr.lab.run.training_data import load_training_data
from torchrl_osr.trainers import OfflineTrainer

log = logging.getLogger(__name__)

schema.register()


def main() -> None:
    """Train as the command line says."""
    sys.argv += schema.named_by_what_differs(sys.argv[1:])
    train()


@hydra.main(version_base="1.3", config_path=CONF, config_name="train")
@single_job
def train(cfg: DictConfig) -> float:
    """Do or continue one run; return its last score or return, for a sweeper."""
    job = HydraConfig.get()
    folder = Path(cfg.resume or job.runtime.output_dir).absolute()
    trust = list(cfg.trust)  # by the command line, not by a run's folder
    fresh = cfg.resume is None
    if fresh:
        trust += module_of(cfg.env.id)
        if cfg.data.path and Path(cfg.data.path).exists():  # seen from any folder
            cfg.data.path = str(Path(cfg.data.path).absolute())
        if cfg.dynamics.path is not None:
            cfg.dynamics.path = str(Path(cfg.dynamics.path).absolute())
    else:
        cfg = run_folder.resumed(folder, cfg, job.overrides.task)
    with run_folder.refusal_noted(folder):
        check_run(cfg, trust)
        read_environment(cfg)
        if fresh:
            check_published(cfg, job.runtime.choices)
    with (
        run_folder.lock(folder),
        run_folder.claimed(folder, cfg, job),
        run_folder.status(folder, trust),
    ):
        return run(cfg, folder)


def run(cfg: DictConfig, folder: Path) -> float:
    """Data, networks, models, policy, report."""
    device, autocast = prepare_machine(cfg, folder)
    spec = environment_spec(cfg.env.id)
    sizes = spec.observation_size, spec.action_size
    in_keys = check_parts(cfg, *sizes)
    if cfg.dynamics.use and cfg.dynamics.path and not (folder / DYNAMICS).exists():
        load_dynamics(cfg.dynamics.path)  # there, and whole: before the data
    told = about(cfg, folder) if cfg.logger.kind == "wandb" else {}
    loggers = make_loggers(folder=folder, **cfg.logger, **told)

    # Transitions with standardised states. Each batch gets a perturbed state for every
    # state, which is the paper's mixed data set.
    data = load_training_data(cfg, device, in_keys)
    torch.manual_seed(cfg.seed)
    noise = {"std": cfg.perturbation.std, "noise": cfg.perturbation.noise}
    perturbation = StatePerturbation(**noise, seed=cfg.seed)
    data.buffer.append_transform(perturbation)

    learner = make_learner(cfg, *sizes, device)
    components = {
        "perturbation": perturbation,
        "observation_norm": data.norm,
        "settings": run_folder.Settings(cfg),
    }
    new_trainer = trainer_maker(cfg, folder, data, components, loggers, autocast)
    if learner.model is not None:
        train_inverse_dynamics(cfg, folder, data, learner.model, new_trainer)
    imagined = adversary = None
    if cfg.dynamics.use:
        imagined, adversary = train_dynamics(
            cfg, folder, data, learner, perturbation, new_trainer
        )
    trainer = train_policy(
        cfg, folder, data, learner, imagined, adversary, new_trainer,
        played=spec.simulated,
    )  # fmt: skip
    score = report(cfg, folder, data.mean, trainer, loggers)
    if failed := trainer.failed_evaluations:
        raise RuntimeError(
            f"The run is finished, but {len(failed)} of its evaluations failed, the "
            f"last at step {failed[-1]['step']}: {failed[-1]['error']}"
        )
    return score


def prepare_machine(
    cfg: DictConfig, folder: Path
) -> tuple[torch.device, torch.dtype | None]:
    """Say what is trained where, and set torch's threads; device and autocast type."""
    torchrl_logger.setLevel("WARNING")
    versions = ", ".join(f"{name} {each}" for name, each in code_versions().items())
    log.info(f"{cfg.env.name} {cfg.data.source}, seed {cfg.seed}, in {folder}")
    log.info(versions)
    torch.set_num_threads(cfg.trainer.num_threads)
    torch.set_float32_matmul_precision(cfg.trainer.matmul_precision)
    precisions = {"float32": None, "bfloat16": torch.bfloat16}
    return torch.device(cfg.trainer.device), precisions[cfg.trainer.precision]


def code_versions() -> dict[str, str]:
    """Versions of the packages, and the commit of a checkout."""
    commit = run_folder.code_commit()
    return run_folder.package_versions() | ({"commit": commit} if commit else {})


def about(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """What W&B shall know of the run: name, group of its seeds, tags, configuration."""
    began = read_yaml(folder / ".hydra" / "hydra.yaml")["hydra"]
    data = f"{cfg.env.name}-{cfg.data.source}"
    method = schema.method_name(began["runtime"]["choices"])
    sweep = [folder.parent.name] if began["mode"] == "MULTIRUN" else []
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return {
        "name": f"{data} {method} seed{cfg.seed}",
        "group": f"{data} {method}",
        "tags": [cfg.env.name, cfg.data.source, method, *sweep],
        "config": settings | {"versions": code_versions()},
    }


def report(
    cfg: DictConfig,
    folder: Path,
    data_mean: float | None,
    trainer: OfflineTrainer,
    loggers: list[Logger],
) -> float:
    """Write raw returns and the figure, print the table; return the last score.

    Without a simulator there are no evaluations, and the score is NaN.
    """
    history, best = trainer.history, trainer.best()
    measure = "return" if references_of(cfg) is None else "score"
    rows = {}
    if history:
        assert best is not None  # the first evaluation, if no other
        rows = {"last": history[-1], "best": best}
    results = {"versions": code_versions(), f"data_{measure}": data_mean, **rows}
    write_json(folder / "returns.json", results | {"evaluations": history})
    name = f"{cfg.env.name} {cfg.data.source}"
    parts = [each for each in (cfg.loss, cfg.recovery) if each is not None]
    method = " and ".join(each._target_.rpartition(".")[2] for each in parts)
    learning_curve(
        history,
        read_scalars(folder / "csv" / "scalars" / "policy"),
        folder / "curve.png",
        title=f"{name}, {method}, seed {cfg.seed}",
        data_mean=data_mean,
    )
    log_outcome(loggers, rows, {"curve": folder / "curve.png"})
    if not rows:
        print(f"\n{name}: nothing was played, for {cfg.env.id} has no simulator")
        print(f"  {'files':<26}{folder}")
        return math.nan
    print("\n" + score_table(name, history, rows["best"], data_mean, folder))
    return float(history[-1][measure])


if __name__ == "__main__":
    main()
