"""Training a run: inverse dynamics model, models of the dynamics, policy, report.

``examples/offline_osr.py`` has the same steps for OSR alone, on one page, from the
functions at the end.
"""

from __future__ import annotations

import logging
import math
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import torch
from hydra.utils import instantiate
from torch.nn import Parameter
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel
from torchrl import torchrl_logger
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule, SoftUpdate, TargetNetUpdater
from torchrl.record.loggers import CSVLogger, Logger, get_logger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_osr import StatePerturbation
from torchrl_osr._checks import needed_by
from torchrl_osr._files import write_atomically, write_json
from torchrl_osr.fast import FastUpdate
from torchrl_osr.lab.data.rows import take_multi_step
from torchrl_osr.lab.dynamics import ModelData, RolloutReplayBuffer, training
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    deterministic_policy,
    inverse_dynamics_report,
    summarize,
)
from torchrl_osr.lab.evaluation.figures import learning_curve, read_scalars
from torchrl_osr.lab.evaluation.tables import run_summary
from torchrl_osr.lab.run.build import Learner, make_learner, try_out
from torchrl_osr.lab.run.config import write_config
from torchrl_osr.lab.run.data import load_training_data, references_of
from torchrl_osr.lab.run.folder import Run, package_versions
from torchrl_osr.lab.run.load import CHECKPOINTS, POLICY, policy_of, restore
from torchrl_osr.trainers import Evaluation, Hook, OfflineTrainer, divergence_warning

log = logging.getLogger(__name__)

adam = partial(torch.optim.Adam, fused=True)

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes


def train(run: Run) -> float:
    """Train a run, or continue it; return its last score or return, for a sweeper."""
    phases = Phases(run)
    if run.config.dynamics.xml:
        env: Any = run.config.env  # the data fit it
        run.config.dynamics.body().check(env.observation_size, env.action_size)
    if phases.learner.model is not None:
        phases.train_inverse_dynamics()
    rollouts = phases.train_dynamics() if run.config.dynamics.use else None
    trainer = phases.train_policy(rollouts)
    save_policies(run, phases.learner, phases.data.norm)
    return report(run, phases.data.data_mean, trainer)


def saved(norm: ObservationNorm) -> Any:
    """Return what a checkpoint saves and does not restore: the rows have this norm."""
    return SimpleNamespace(state_dict=norm.state_dict, load_state_dict=lambda _: None)


class Phases:
    """The phases of a run's training, and what they share: networks, data, options."""

    def __init__(self, run: Run) -> None:
        self.run, self.config = run, (config := run.config)
        device, self.autocast = prepare_machine(run)
        # Before the data are made: a wrong option costs no time.
        torch.manual_seed(config.seed)
        self.learner = make_learner(config, device)
        if config.env.id is not None:
            try_out(config.env.id)
        self.options = trainer_options(run)
        noise = StatePerturbation(config.perturbation.std, seed=config.seed)
        self.perturbation = noise.to(device)
        # Transitions with standardised states. Each batch gets a perturbed state for
        # every state, which is the paper's mixed data set.
        self.data = load_training_data(config, device, self.learner.objective.in_keys)
        write_config(run.folder, config)  # with the checksum of the data
        self.data.buffer.append_transform(self.perturbation)

    def trainer(
        self,
        name: str,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target_updater: TargetNetUpdater | None = None,
        *,
        policy_params: Sequence[Parameter] = (),
        components: Mapping[str, Any] | None = None,
        **own: Any,
    ) -> OfflineTrainer:
        """Make the trainer of a phase."""
        config, data = self.config, self.data
        if config.trainer.compile:
            loss.compile()
        update = FastUpdate(
            loss,
            optimizer,
            target_updater,
            policy_delay=config.optim.policy_delay if policy_params else 1,
            policy_params=policy_params,
            autocast_dtype=self.autocast,
            trace=config.trainer.record,
        )
        kept = {"perturbation": self.perturbation, "observation_norm": saved(data.norm)}
        return OfflineTrainer(
            update,
            folder=self.run.folder / "checkpoint" / name,
            components=kept | dict(components or {}),
            description=name,
            **{"replay_buffer": data.buffer, **self.options, **own},
        )

    def fit(
        self, lr: float, name: str, loss: LossModule, parameters: Any, **options: Any
    ) -> OfflineTrainer:
        """Train a model that the policy's loss then holds frozen."""
        optimizer = adam(parameters, lr=lr)
        trainer = self.trainer(name, loss, optimizer, seed=self.config.seed, **options)
        trainer.train()
        return trainer

    def train_inverse_dynamics(self) -> None:
        """Train the model: which action leads from a perturbed state to the next state?

        Its last numbers are printed, and left in ``inverse_dynamics.json``.
        """
        config, model, rows = self.config, self.learner.model, self.data.held_out
        assert model is not None
        steps = config.trainer.inverse_dynamics_steps
        loss = instantiate(config.inverse_dynamics.loss, _partial_=True)(model)
        trainer = self.fit(
            config.optim.inverse_dynamics_lr,
            "inverse_dynamics",
            loss,
            loss.parameters(),
            total_steps=steps,
            evaluation=Evaluation(
                lambda: inverse_dynamics_report(model, rows), steps, "nll", "min"
            ),
        )
        found = trainer.history[-1]
        write_json(self.run.folder / "inverse_dynamics.json", found)
        if "accuracy" in found:
            fit = f"{100 * found['accuracy']:.0f} % of the actions"
        else:
            r2 = ["-" if each is None else f"{each:.2f}" for each in found["r2"]]
            fit = f"R2 {', '.join(r2)}"
        rows, nll = found["rows"], found["nll"]
        print(f"inverse dynamics, {rows} held-out rows: NLL {nll:.2f}, {fit}")

    def train_dynamics(self) -> RolloutReplayBuffer | None:
        """Train models of the dynamics, see ``lab/dynamics/training.py``."""
        config, data = self.config, self.data
        model_data = ModelData(
            storage=data.buffer.storage,
            held_out=data.held_out,
            loc=data.norm.loc,
            scale=data.norm.scale,
            reward_scale=config.data.reward_scale,
            gamma=config.optim.gamma,
            env_id=config.env.id,
            seed=config.seed,
            action_low=config.env.action_low or -1.0,
            action_high=config.env.action_high or 1.0,
        )
        return training.train_dynamics(
            config.dynamics,
            model_data,
            self.learner.objective,
            self.learner.actor,
            partial(self.fit, config.dynamics.lr),
            self.run.folder,
            batch_size=config.trainer.batch_size,
            n_steps=config.optim.n_steps,
            transform=self.perturbation,
        )

    def train_policy(self, rollouts: RolloutReplayBuffer | None) -> OfflineTrainer:
        """Train the policy, by the critics and frozen models; return its trainer.

        Batches are from ``rollouts`` in part, if there are any. It is evaluated if its
        environment is simulated.
        """
        run, config, optim, data = self.run, self.config, self.config.optim, self.data
        actor, _, loss, objective = self.learner
        names = ("qvalue_network_params", "value_network_params")
        networks = [getattr(loss, name) for name in names if hasattr(loss, name)]
        critics = [each for network in networks for each in network.parameters()]
        known = set(critics)
        policy = [each for each in objective.parameters() if each not in known]
        optimizer, schedule = optimizer_of(run, critics, policy)
        targets = SoftUpdate(loss, tau=optim.tau) if critics else None
        average = averaged(actor, optim.policy_average)
        components = {"schedule": schedule, "policy_average": average}
        hooks: list[Hook] = [
            # The policy of an earlier, shorter training.
            ("pre_optim_steps", partial((run.folder / POLICY).unlink, missing_ok=True)),
            divergence_warning(data.largest_reward, optim.gamma),
            ("post_optim", schedule.step),
            ("post_optim", partial(average.update_parameters, actor)),
        ]
        if hasattr(loss, "decay_uncertainty"):
            hooks.append(("post_optim", loss.decay_uncertainty))
        if rollouts is not None:
            components["rollouts"] = rollouts
        elif optim.n_steps > 1:
            data.buffer.append_transform(take_multi_step)
        with evaluation(run, data.norm, average) as evaluate:
            trainer = self.trainer(
                "policy",
                objective,
                optimizer,
                targets,
                replay_buffer=data.buffer if rollouts is None else rollouts,
                hooks=hooks,
                components=components,
                total_steps=config.trainer.steps,
                seed=config.seed + 1,
                policy_params=policy,
                evaluation=evaluate,
            )
            trainer.train()
        return trainer


def prepare_machine(run: Run) -> tuple[torch.device, torch.dtype | None]:
    """Log versions; set threads and precision; return device and autocast type."""
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
            "log_env_packages": False,  # TorchRL would write them over our "env"
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

    def factor(step: int) -> float:
        share = min(step / total, 1) if optim.actor_schedule == "cosine" else 0.0
        return 0.5 * (1 + math.cos(math.pi * share))

    groups = [{"params": critics, "lr": optim.qvalue_lr}] * bool(critics)
    optimizer = adam([*groups, {"params": policy, "lr": optim.actor_lr}])
    factors: list[Any] = [lambda _: 1.0] * len(groups)
    return optimizer, LambdaLR(optimizer, [*factors, factor])


def averaged(network: torch.nn.Module, share: float) -> AveragedModel:
    """Return an exponential average of a network's weights; it is evaluated.

    ``share`` is that of the new weights at each update. The first weights would stay in
    the average for longer than a short run lasts: until update number ``10 / share`` it
    covers about the last tenth of all updates.
    """

    @torch.no_grad()
    def move(average: Any, weights: Any, _: Any) -> None:
        count = int(model.n_averaged)  # on the host, unlike what is passed
        torch._foreach_lerp_(average, weights, max(share, 10 / (count + 10)))

    model = AveragedModel(network, multi_avg_fn=move)
    return model


@contextmanager
def evaluation(
    run: Run, norm: ObservationNorm, average: AveragedModel
) -> Iterator[Evaluation | None]:
    """Open the episodes that evaluate the averaged policy; ``None``: no simulator."""
    env = run.config.env
    if env.id is None:
        yield None
        return
    references = references_of(env)
    episodes = EpisodeEvaluator(
        env.id,
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

    Without a simulator there are no evaluations, and the score is NaN. A RuntimeError
    names evaluations that failed.
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
    scalars = read_scalars(folder / "csv" / "scalars" / "policy")
    title, curve = f"{name}, {run.method}, seed {config.seed}", folder / "curve.png"
    learning_curve(history, scalars, curve, title=title, data_mean=data_mean)
    for logger in trainer.loggers:
        if isinstance(logger, WandbLogger):
            import wandb

            logger.experiment.log({"curve": wandb.Image(str(curve))})
            logger.experiment.finish()
    if not history:
        print(f"\n{name}, in {folder}: the policy is trained, and was never played")
        return math.nan
    print("\n" + run_summary(name, history, rows["best"], data_mean, folder))
    if failed := [f"step {n}: {e}" for n, e in trainer.failed_evaluations.items()]:
        raise RuntimeError(
            "The training is complete and the policy is saved, but evaluations in "
            f"{config.env.id} failed: {'; '.join(failed)}"
        )
    return float(history[-1][measure])
