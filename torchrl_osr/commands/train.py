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
import sys
from collections.abc import Mapping
from contextlib import closing
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl import torchrl_logger
from torchrl.record.loggers import Logger
from torchrl.trainers import LRSchedulerHook

from torchrl_osr import StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.commands import CONF
from torchrl_osr.commands.console import single_job
from torchrl_osr.data import environment_spec
from torchrl_osr.evaluation import (
    EpisodeEvaluator,
    describe_inverse_dynamics,
    deterministic_policy,
    inverse_dynamics_report,
    learning_curve,
    measure_of,
    read_scalars,
    score_table,
    summarize,
)
from torchrl_osr.experiment import run_folder, schema
from torchrl_osr.experiment.build import (
    check_parts,
    make_learner,
    make_reverse_vae,
    make_transition_vae,
    read_environment,
    references_of,
)
from torchrl_osr.experiment.conditional_vae import train_vae
from torchrl_osr.experiment.dynamics import (
    dynamics_model,
    imagined_replay_buffer,
    model_adversary,
)
from torchrl_osr.experiment.loggers import log_outcome, make_loggers
from torchrl_osr.experiment.run_config import check_run, module_of, read_yaml
from torchrl_osr.experiment.training_data import load_training_data
from torchrl_osr.imagination import ImaginedReplayBuffer, ModelAdversary
from torchrl_osr.trainers import (
    OfflineTrainer,
    SoftUpdate,
    check_hardware,
    largest_value,
    learning_rates,
)

log = logging.getLogger(__name__)

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes

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
    else:
        cfg = run_folder.resumed(folder, cfg, job.overrides.task)
    with run_folder.refusal_noted(folder):
        check_run(cfg, trust)
        if fresh:
            read_environment(cfg)
            check_published(cfg, job.runtime.choices)
    with run_folder.lock(folder):
        run_folder.claim(folder, cfg, job)
        with run_folder.status(folder):
            return run(cfg, folder)


def run(cfg: DictConfig, folder: Path) -> float:
    """Data, networks, inverse dynamics model, policy, report."""
    torchrl_logger.setLevel("WARNING")
    versions = ", ".join(f"{name} {each}" for name, each in code_versions().items())
    log.info(f"{cfg.env.name} {cfg.data.quality}, seed {cfg.seed}, in {folder}")
    log.info(versions)
    torch.set_num_threads(cfg.trainer.num_threads)
    torch.set_float32_matmul_precision(cfg.trainer.matmul_precision)
    device, autocast = check_hardware(
        cfg.trainer.device,
        cfg.trainer.precision,
        cudagraph=cfg.trainer.cudagraph,
        policy_delay=cfg.optim.policy_delay,
    )
    spec, references = environment_spec(cfg.env.id), references_of(cfg)
    sizes = spec.observation_size, spec.action_size
    in_keys = check_parts(cfg, *sizes)

    # Transitions with standardised states. Each batch gets a perturbed state for every
    # state, which is the paper's mixed data set.
    data = load_training_data(cfg, device, in_keys)
    torch.manual_seed(cfg.seed)
    noise = {"std": cfg.perturbation.std, "noise": cfg.perturbation.noise}
    perturbation = StatePerturbation(**noise, seed=cfg.seed)
    data.buffer.append_transform(perturbation)

    # Networks, the policy's loss, and the objective: the loss, or with it a recovery
    # term. Either holds the inverse dynamics model, if one is used.
    actor, inverse_dynamics, loss, objective = make_learner(cfg, *sizes, device)

    told = about(cfg, folder) if cfg.logger.kind == "wandb" else {}
    loggers = make_loggers(folder=folder, **cfg.logger, **told)

    components = {
        "perturbation": perturbation,
        "observation_norm": data.norm,
        "settings": run_folder.Settings(cfg),
    }
    # One step of a trainer: sample a batch, compute the losses, go backward on their
    # sum, step the optimizer, move the target networks; log, evaluate and write a
    # checkpoint at their intervals. Both phases have this in common:
    new_trainer = partial(
        OfflineTrainer,
        replay_buffer=data.buffer,
        components=components,
        loggers=loggers,
        log_interval=cfg.trainer.log_interval,
        checkpoint_interval=cfg.trainer.checkpoint_interval,
        checkpoints_kept=cfg.trainer.checkpoints_kept,
        progress=cfg.trainer.progress,
        nonfinite=cfg.trainer.nonfinite,
        autocast_dtype=autocast,
        record=cfg.trainer.record,
        compile=cfg.trainer.compile,
        cudagraph=cfg.trainer.cudagraph,
    )
    # At each log entry: in a folder that was removed nothing would be kept.
    still_ours = partial(run_folder.check_ours, folder)
    adam = partial(torch.optim.Adam, fused=True, capturable=cfg.trainer.cudagraph)

    # First phase: which action leads from the perturbed state to the next state?
    if inverse_dynamics is not None:
        fit = instantiate(cfg.inverse_dynamics.loss, _partial_=True)(inverse_dynamics)
        trainer = new_trainer(
            fit,
            adam(fit.parameters(), lr=cfg.optim.inverse_dynamics_lr),
            total_steps=cfg.trainer.inverse_dynamics_steps,
            folder=folder / "checkpoint" / "inverse_dynamics",
            seed=cfg.seed,
            evaluate=lambda: inverse_dynamics_report(inverse_dynamics, data.held_out),
            metric=("nll", "min"),
            eval_interval=cfg.trainer.inverse_dynamics_steps,
            description="inverse_dynamics",
        )
        trainer.register_op("post_steps", still_ours)
        if cfg.inverse_dynamics.shuffle_next:
            trainer.register_op("process_optim_batch", shuffle_next)
        trainer.train()
        write_json(folder / "inverse_dynamics.json", trainer.history[-1])
        print(describe_inverse_dynamics(trainer.history[-1]))

    # A model of the dynamics, and batches in part of what is imagined in it.
    buffer, imagined, adversary = data.buffer, None, None
    if cfg.dynamics.use:
        reverse = cfg.dynamics.reverse_policy
        of_model = data if reverse is None else data.reverse()
        model = dynamics_model(cfg, of_model, folder, new_trainer, adam)
        if hasattr(loss, "dynamics_network"):
            loss.load_network("dynamics_network", model)
        if hasattr(loss, "transition_network"):
            vae = make_transition_vae(cfg, sizes[0])
            train_vae(vae, cfg, data, folder, new_trainer, adam)
            loss.load_network("transition_network", vae)
    if cfg.dynamics.use and cfg.dynamics.real_ratio < 1:
        imagining: torch.nn.Module = actor
        if reverse == "cvae":
            imagining = make_reverse_vae(cfg, *sizes)
            train_vae(imagining, cfg, data, folder, new_trainer, adam)
        if cfg.dynamics.adversarial_steps:
            adversary = model_adversary(cfg, data, model, actor, loss, adam)
            # Before the roll-outs, which are of a copy of it.
            components |= {"adversary": adversary}
        buffer = imagined = imagined_replay_buffer(
            cfg, data, model, imagining, perturbation, adversary
        )
        components |= {"imagined": imagined}

    # Second phase: the policy, taught by the critics and by the frozen model.
    names = [f"{kind}_network_params" for kind in ("qvalue", "value")]
    critics = [getattr(loss, name) for name in names if hasattr(loss, name)]
    critic_params = [each for critic in critics for each in critic.parameters()]
    known = set(critic_params)
    policy_params = [each for each in objective.parameters() if each not in known]
    optim = cfg.optim
    trained = [
        (critic_params, optim.qvalue_lr, optim.qvalue_schedule),
        (policy_params, optim.actor_lr, optim.actor_schedule),
    ]
    trained = [each for each in trained if each[0]]  # cloning has no critics
    optimizer = adam([{"params": params, "lr": rate} for params, rate, _ in trained])
    kinds = [kind for *_, kind in trained]
    schedule = learning_rates(optimizer, kinds, cfg.trainer.steps)
    # What is played, now and by all other commands.
    share, average = optim.policy_average, deepcopy(actor)
    weights = list(average.parameters()), list(actor.parameters())
    # The arithmetic of torch.optim.swa_utils.AveragedModel, without its search for the
    # parameters at every update.
    follow = torch.no_grad()(partial(torch._foreach_lerp_, *weights, share))
    has_targets = bool(critic_params) and loss.delay_qvalue
    targets = SoftUpdate(loss, tau=optim.tau) if has_targets else None
    limit = largest_value(data.largest_reward, optim.gamma)
    episodes = {"num_episodes": cfg.trainer.eval_episodes, "seed": EVALUATION_SEED}
    policy = deterministic_policy(average, data.norm)
    last_weights = deterministic_policy(actor, data.norm)
    measure = "return" if references is None else "score"
    with closing(EpisodeEvaluator(cfg.env.id, **episodes, device=device)) as play:

        def evaluate() -> dict[str, Any]:
            results = summarize(play(policy), references)
            if share < 1:
                last = summarize(play(last_weights), references)
                results[f"{measure}_of_last_weights"] = last[measure]
            return results

        trainer = new_trainer(
            objective,
            optimizer,
            replay_buffer=buffer,
            components=components | {"schedule": schedule, "policy_average": average},
            total_steps=cfg.trainer.steps,
            folder=folder / "checkpoint" / "policy",
            seed=cfg.seed + 1,
            target_net_updater=targets,
            policy_delay=optim.policy_delay,
            policy_params=policy_params,
            evaluate=evaluate,
            metric=(measure, "max"),
            eval_interval=cfg.trainer.eval_interval,
            description="policy",
            value_limits={"pred_value": limit, "target_value": limit},
        )
        trainer.register_op("post_steps", still_ours)
        if imagined is not None:
            log_both = partial(log_imagined, trainer, imagined, adversary)
            trainer.register_op("post_steps", log_both)
        LRSchedulerHook(schedule, interval="optim").register(trainer)
        trainer.register_op("post_optim", follow)
        if hasattr(loss, "decay_uncertainty"):
            trainer.register_op("post_optim", loss.decay_uncertainty)
        if cfg.perturbation.adversary is not None:
            adversary = instantiate(cfg.perturbation.adversary)
            trainer.register_op("process_optim_batch", partial(adversary, loss))
        trainer.train()
    return report(cfg, folder, data.mean, trainer, loggers)


def check_published(cfg: DictConfig, choices: Mapping[str, str]) -> None:
    """Warn if a loss's authors have told settings for other data than a run's.

    Raises:
        ValueError: if those of another task would be taken.
    """
    loss, file = choices["loss"], f"{choices['env']}-{choices['data']}.yaml"
    published = Path(CONF) / "published" / loss
    if published.is_dir() and not (published / file).is_file():
        log.warning(
            f"There are no published settings of loss={loss} for {cfg.env.name} "
            f"{cfg.data.quality}: its defaults are taken. {published} has some."
        )
    elif published.is_dir() and cfg.env.name != choices["env"]:
        raise ValueError(
            f"loss={loss} would take the settings that were published for "
            f"{choices['env']}, but env.id={cfg.env.id} is {cfg.env.name}: give "
            f"env={cfg.env.name}."
        )
    known, name = cfg.dynamics.published, f"{cfg.env.name}-{cfg.data.quality}"
    if known and not {name, cfg.env.name} & set(known):
        taken = [
            f"dynamics.{key}={cfg.dynamics[key]}" for key in next(iter(known.values()))
        ]
        log.warning(
            f"There are no published roll-outs of loss={loss} for {name}: "
            f"{' and '.join(taken)} are taken."
        )


def code_versions() -> dict[str, str]:
    """Versions of the packages, and the commit of a checkout."""
    commit = run_folder.code_commit()
    return run_folder.package_versions() | ({"commit": commit} if commit else {})


def about(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """What W&B shall know of the run: name, group of its seeds, tags, configuration."""
    began = read_yaml(folder / ".hydra" / "hydra.yaml")["hydra"]
    data = f"{cfg.env.name}-{cfg.data.quality}"
    method = schema.method_name(began["runtime"]["choices"])
    sweep = [folder.parent.name] if began["mode"] == "MULTIRUN" else []
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    return {
        "name": f"{data} {method} seed{cfg.seed}",
        "group": f"{data} {method}",
        "tags": [cfg.env.name, cfg.data.quality, method, *sweep],
        "config": settings | {"versions": code_versions()},
    }


def log_imagined(
    trainer: OfflineTrainer,
    imagined: ImaginedReplayBuffer,
    adversary: ModelAdversary | None,
) -> None:
    """Log what the rows are like that the policy learns from besides the data."""
    of_model = {} if adversary is None else adversary.metrics
    for name, value in (imagined.metrics() | of_model).items():
        for logger in trainer.loggers:
            logger.log_scalar(f"policy/{name}", value, step=trainer.step)


def shuffle_next(batch: TensorDict) -> TensorDict:
    """Give every row the next state of another: an ablation of the model."""
    key = ("next", "observation")
    return batch.set(key, batch[key].roll(1, 0))  # the rows came in random order


def report(
    cfg: DictConfig,
    folder: Path,
    data_mean: float | None,
    trainer: OfflineTrainer,
    loggers: list[Logger],
) -> float:
    """Write raw returns and the figure, print the table; return the last score."""
    history, best = trainer.history, trainer.best()
    assert best is not None  # there is an evaluation before the first update
    measure = measure_of(best)
    results = {
        "versions": code_versions(),
        f"data_{measure}": data_mean,
        "last": history[-1],
        "best": best,
    }
    write_json(folder / "returns.json", results | {"evaluations": history})
    name = f"{cfg.env.name} {cfg.data.quality}"
    parts = [each for each in (cfg.loss, cfg.recovery) if each is not None]
    method = " and ".join(each._target_.rpartition(".")[2] for each in parts)
    learning_curve(
        history,
        read_scalars(folder / "csv" / "scalars" / "policy"),
        folder / "curve.png",
        title=f"{name}, {method}, seed {cfg.seed}",
        data_mean=data_mean,
    )
    rows = {"last": history[-1], "best": best}
    log_outcome(loggers, cfg, rows, {"curve": folder / "curve.png"})
    print("\n" + score_table(name, history, best, data_mean, folder))
    return float(history[-1][measure])


if __name__ == "__main__":
    main()
