"""Training a run: inverse dynamics model, models of the dynamics, policy, report.

``examples/offline_osr.py`` has the same steps for OSR alone, on one page.
"""

from __future__ import annotations

import logging
import math
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.nn import Parameter
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel
from torchrl import torchrl_logger
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule, SoftUpdate, TargetNetUpdater
from torchrl.record.loggers import CSVLogger, Logger, get_logger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_osr import StatePerturbation
from torchrl_osr._files import write_atomically, write_json
from torchrl_osr.fast import fast_update
from torchrl_osr.lab.data.rows import take_multi_step
from torchrl_osr.lab.dynamics import (
    ModelAdversary,
    ModelData,
    RolloutReplayBuffer,
    training,
)
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    describe_inverse_dynamics,
    deterministic_policy,
    inverse_dynamics_report,
    measure_of,
    summarize,
)
from torchrl_osr.lab.evaluation.figures import learning_curve
from torchrl_osr.lab.evaluation.training_summary import read_scalars, score_table
from torchrl_osr.lab.run.build import Learner, make_learner, try_out
from torchrl_osr.lab.run.data import TrainingData, load_training_data, references_of
from torchrl_osr.lab.run.folder import Run, Settings, check_ours, code_versions
from torchrl_osr.lab.run.load import CHECKPOINTS, POLICY, policy_of, restore
from torchrl_osr.trainers import Evaluation, OfflineTrainer, largest_value

log = logging.getLogger(__name__)

adam = partial(torch.optim.Adam, fused=True)

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes

NewTrainer = Callable[..., OfflineTrainer]
"""Makes the trainer of a phase, see :func:`trainer_maker`."""


def train(run: Run) -> float:
    """Train a run, or continue it; return its last score or return, for a sweeper."""
    config = run.config
    device, autocast = prepare_machine(run)
    # Before the data are made: a wrong option costs no time.
    torch.manual_seed(config.seed)
    learner = make_learner(config, device)
    if run.simulated:
        try_out(config.env.id)
    if config.dynamics.use and config.dynamics.path:
        training.load_dynamics(config.dynamics.path)
    loggers = make_loggers(run)

    # Transitions with standardised states. Each batch gets a perturbed state for every
    # state, which is the paper's mixed data set.
    data = load_training_data(
        config.env,
        config.data,
        batch_size=config.trainer.batch_size,
        device=device,
        in_keys=learner.objective.in_keys,
        n_steps=config.optim.n_steps,
        gamma=config.optim.gamma,
        pieces=config.dynamics.use,
        progress=config.trainer.progress,
    )
    noise: Any = config.perturbation.noise
    perturbation = StatePerturbation(
        config.perturbation.std, noise=noise, seed=config.seed
    )
    data.buffer.append_transform(perturbation)

    new_trainer = trainer_maker(run, data, perturbation, loggers, autocast)
    if learner.model is not None:
        train_inverse_dynamics(run, data, learner.model, new_trainer)
    rollouts = adversary = None
    if config.dynamics.use:
        rollouts, adversary = train_dynamics(
            run, data, learner, perturbation, new_trainer
        )
    trainer = train_policy(run, data, learner, rollouts, adversary, new_trainer)
    save_policies(run, learner, data.norm)
    return report(run, data.mean, trainer, loggers)


def prepare_machine(run: Run) -> tuple[torch.device, torch.dtype | None]:
    """Log what is trained where, and set torch's threads; device and autocast type."""
    config = run.config
    torchrl_logger.setLevel("WARNING")
    versions = ", ".join(f"{name} {each}" for name, each in code_versions().items())
    log.info(
        f"{config.env.name} {config.data.source}, seed {config.seed}, in {run.folder}"
    )
    log.info(versions)
    torch.set_num_threads(config.trainer.num_threads)
    torch.set_float32_matmul_precision(config.trainer.matmul_precision)
    precisions = {"float32": None, "bfloat16": torch.bfloat16}
    return torch.device(config.trainer.device), precisions[config.trainer.precision]


def make_loggers(run: Run) -> list[Logger]:
    """Make the CSV logger, which figures are drawn from, and the one that is chosen.

    A continued run continues its W&B run.

    Raises:
        ImportError: if the logger's package is not installed.
    """
    config, folder, kind = run.config, run.folder, run.config.logger.kind
    loggers: list[Logger] = [CSVLogger("csv", log_dir=str(folder))]
    if kind == "csv":
        return loggers
    if find_spec(kind) is None:
        extra = "wandb" if kind == "wandb" else "train"
        raise ImportError(
            f"logger={kind} needs {kind!r}: pip install 'torchrl-osr[{extra}]'"
        )
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
            "tags": [config.env.name, config.data.source, run.method],
            "config": asdict(config) | {"versions": code_versions()},
        }
    return [*loggers, get_logger(kind, str(folder), name, wandb_kwargs=options)]


def trainer_maker(
    run: Run,
    data: TrainingData,
    perturbation: StatePerturbation,
    loggers: Sequence[Logger],
    autocast: torch.dtype | None = None,
) -> NewTrainer:
    """Return a function that makes a phase's trainer, with what all phases share.

    One step of a trainer: sample a batch, compute the losses, go backward on their sum,
    step the optimizer, move the target networks; log, evaluate and write a checkpoint
    at their intervals.
    """
    config, options = run.config, run.config.trainer
    shared: dict[str, Any] = {
        "perturbation": perturbation,
        "observation_norm": data.norm,
        "settings": Settings(config),
    }

    def new_trainer(
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target_updater: TargetNetUpdater | None = None,
        *,
        policy_params: Sequence[Parameter] = (),
        components: Mapping[str, Any] | None = None,
        hooks: Sequence[tuple[str, Callable[..., Any]]] = (),
        **own: Any,
    ) -> OfflineTrainer:
        if options.compile:
            loss.compile()
        update = fast_update(
            loss,
            optimizer,
            target_updater,
            policy_delay=config.optim.policy_delay if policy_params else 1,
            policy_params=policy_params,
            autocast_dtype=autocast,
            trace=options.record,
        )
        # In a folder that was removed nothing would be kept.
        removed = ("post_steps", partial(check_ours, run.folder))
        return OfflineTrainer(
            update,
            hooks=[removed, *hooks],
            components=shared | dict(components or {}),
            loggers=loggers,
            log_interval=options.log_interval,
            checkpoint_interval=options.checkpoint_interval,
            checkpoints_kept=options.checkpoints_kept,
            progress=options.progress,
            **{"replay_buffer": data.buffer} | own,
        )

    return new_trainer


def train_inverse_dynamics(
    run: Run,
    data: TrainingData,
    model: ProbabilisticTensorDictSequential,
    new_trainer: NewTrainer,
) -> None:
    """Train the model: which action leads from a perturbed state to the next state?

    Its last numbers are printed, and left in ``inverse_dynamics.json``.
    """
    config, steps = run.config, run.config.trainer.inverse_dynamics_steps
    shuffled = config.inverse_dynamics.shuffle_next
    loss = instantiate(config.inverse_dynamics.loss, _partial_=True)(model)
    trainer = new_trainer(
        loss,
        adam(loss.parameters(), lr=config.optim.inverse_dynamics_lr),
        total_steps=steps,
        folder=run.folder / "checkpoint" / "inverse_dynamics",
        seed=config.seed,
        evaluation=Evaluation(
            lambda: inverse_dynamics_report(model, data.held_out), steps, "nll", "min"
        ),
        description="inverse_dynamics",
        hooks=[("process_optim_batch", _shuffle_next)] * shuffled,
    )
    trainer.train()
    write_json(run.folder / "inverse_dynamics.json", trainer.history[-1])
    print(describe_inverse_dynamics(trainer.history[-1]))


def train_dynamics(
    run: Run,
    data: TrainingData,
    learner: Learner,
    perturbation: StatePerturbation,
    new_trainer: NewTrainer,
) -> tuple[RolloutReplayBuffer | None, ModelAdversary | None]:
    """Train models of the dynamics, see ``lab/dynamics/training.py``."""
    config, arithmetic = run.config, asdict(run.config.trainer)
    model_data = ModelData(
        data.buffer.storage,
        data.held_out,
        data.pieces,
        data.norm.loc,
        data.norm.scale,
        config.data.reward_scale,
        config.data.reward_shift,
        config.env.id,
    )
    names = "device", "precision", "matmul_precision", "compile"
    phase = training.Phase(
        run.folder,
        new_trainer,
        adam,
        config.seed,
        name=f"{config.env.name}-{config.data.source}",
        arithmetic={name: arithmetic[name] for name in names},
    )
    return training.train_dynamics(
        config.dynamics,
        model_data,
        learner.objective,
        learner.actor,
        phase,
        batch_size=config.trainer.batch_size,
        gamma=config.optim.gamma,
        n_steps=config.optim.n_steps,
        transform=perturbation,
    )


def train_policy(
    run: Run,
    data: TrainingData,
    learner: Learner,
    rollouts: RolloutReplayBuffer | None,
    adversary: ModelAdversary | None,
    new_trainer: NewTrainer,
) -> OfflineTrainer:
    """Train the policy, by the critics and frozen models; return its trainer.

    Batches are from ``rollouts`` in part, if there are any; the ``adversary`` trains
    the model of the dynamics on. It is evaluated if its environment is simulated.
    """
    config, optim = run.config, run.config.optim
    actor, _, loss, objective = learner
    critics, policy = _parameters_of(learner)
    optimizer, schedule = _optimizer_of(run, critics, policy)
    targets = None
    if critics and loss.delay_qvalue:  # cloning has no critics
        targets = SoftUpdate(loss, tau=optim.tau)
    average = averaged(actor, optim.policy_average)
    components = {"schedule": schedule, "policy_average": average}
    hooks: list[tuple[str, Callable[..., Any]]] = [
        ("post_optim", schedule.step),
        ("post_optim", partial(average.update_parameters, actor)),
    ]
    if hasattr(loss, "decay_uncertainty"):
        hooks.append(("post_optim", loss.decay_uncertainty))
    if config.perturbation.adversary is not None:
        attack = instantiate(config.perturbation.adversary)
        hooks.append(("process_optim_batch", partial(attack, loss)))
    if adversary is not None:  # before the roll-outs, which are of a copy of it
        components["adversary"] = adversary
    if rollouts is not None:
        components["imagined"] = rollouts
        hooks.append(
            ("post_steps", lambda: _log_rollouts(trainer, rollouts, adversary))
        )
    elif optim.n_steps > 1:
        data.buffer.append_transform(take_multi_step)
    limit = largest_value(data.largest_reward, optim.gamma)
    with evaluation(run, data.norm, actor, average) as evaluate:
        trainer = new_trainer(
            objective,
            optimizer,
            targets,
            replay_buffer=data.buffer if rollouts is None else rollouts,
            hooks=hooks,
            components=components,
            total_steps=config.trainer.steps,
            folder=run.folder / CHECKPOINTS,
            seed=config.seed + 1,
            policy_params=policy,
            evaluation=evaluate,
            description="policy",
            value_limits={"pred_value": limit, "target_value": limit},
        )
        trainer.train()
    return trainer


def averaged(network: torch.nn.Module, share: float) -> AveragedModel:
    """Return an exponential average of a network's weights, which is what is evaluated.

    It forgets the first weights, which would stay in it for longer than a short run
    lasts: until update number ``10 / share`` it is of about the last tenth of all
    updates.

    Args:
        network: is copied.
        share: of the new weights at each update; 1 for the weights themselves.
    """

    @torch.no_grad()
    def move(average: Any, weights: Any, count: Tensor | int) -> None:
        torch._foreach_lerp_(average, weights, max(share, 10 / (int(count) + 10)))

    return AveragedModel(network, multi_avg_fn=move)


@contextmanager
def evaluation(
    run: Run,
    norm: ObservationNorm,
    actor: ProbabilisticTensorDictSequential,
    average: AveragedModel,
) -> Iterator[Evaluation | None]:
    """Open the episodes that evaluate a policy.

    It plays the averaged weights, and the last ones besides if they differ. ``None``
    without a simulator.
    """
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
        results = summarize(
            episodes(deterministic_policy(average.module, norm)), references
        )
        if run.config.optim.policy_average < 1:
            last = summarize(episodes(deterministic_policy(actor, norm)), references)
            measure = measure_of(last)
            results[f"{measure}_of_last_weights"] = last[measure]
        return results

    measure = "return" if references is None else "score"
    with closing(episodes):
        yield Evaluation(evaluate, run.config.trainer.eval_interval, measure)


def _parameters_of(learner: Learner) -> tuple[list[Parameter], list[Parameter]]:
    """Parameters of the critics, if there are any, and of all else that is trained."""
    loss, names = learner.loss, ("qvalue_network_params", "value_network_params")
    networks = [getattr(loss, name) for name in names if hasattr(loss, name)]
    critics = [each for network in networks for each in network.parameters()]
    known = set(critics)
    rest = [each for each in learner.objective.parameters() if each not in known]
    return critics, rest


def _optimizer_of(
    run: Run, critics: list[Parameter], policy: list[Parameter]
) -> tuple[torch.optim.Optimizer, LambdaLR]:
    """Adam with a learning rate and a schedule for critics and policy each."""
    optim = run.config.optim
    trained = [
        (critics, optim.qvalue_lr, optim.qvalue_schedule),
        (policy, optim.actor_lr, optim.actor_schedule),
    ]
    trained = [each for each in trained if each[0]]
    groups = [{"params": params, "lr": rate} for params, rate, _ in trained]
    optimizer = adam(groups)

    def cosine(step: int) -> float:
        return 0.5 * (1 + math.cos(math.pi * min(step / run.config.trainer.steps, 1)))

    factors = {"cosine": cosine, "constant": lambda _: 1.0}
    return optimizer, LambdaLR(optimizer, [factors[kind] for *_, kind in trained])


def _log_rollouts(
    trainer: OfflineTrainer,
    rollouts: RolloutReplayBuffer,
    adversary: ModelAdversary | None,
) -> None:
    """Log numbers of the synthetic rows."""
    of_model = {} if adversary is None else adversary.metrics
    for name, value in (rollouts.metrics() | of_model).items():
        for logger in trainer.loggers:
            logger.log_scalar(f"policy/{name}", value, step=trainer.step)


def _shuffle_next(batch: TensorDict) -> TensorDict:
    """Give every row the next state of another: an ablation of the model."""
    key = ("next", "observation")
    return batch.set(key, batch[key].roll(1, 0))  # the rows came in random order


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


def report(
    run: Run,
    data_mean: float | None,
    trainer: OfflineTrainer,
    loggers: Sequence[Logger] = (),
) -> float:
    """Write raw returns and the figure, print the table; return the last score.

    Without a simulator there are no evaluations, and the score is NaN.
    """
    config, folder = run.config, run.folder
    history, best = trainer.history, trainer.best()
    measure = "return" if references_of(config.env) is None else "score"
    rows: dict[str, Any] = {}
    if history:
        rows = {"last": history[-1], "best": best or history[0]}
    results = {"versions": code_versions(), f"data_{measure}": data_mean, **rows}
    write_json(folder / "returns.json", results | {"evaluations": history})
    name = f"{config.env.name} {config.data.source}"
    learning_curve(
        history,
        read_scalars(folder / "csv" / "scalars" / "policy"),
        folder / "curve.png",
        title=f"{name}, {run.method}, seed {config.seed}",
        data_mean=data_mean,
    )
    _finish_wandb(loggers, rows, folder / "curve.png")
    if not rows:
        print(f"\n{name}: nothing was played, for {config.env.id} has no simulator")
        print(f"  {'files':<26}{folder}")
        return math.nan
    print("\n" + score_table(name, history, rows["best"], data_mean, folder))
    if failed := trainer.failed_evaluations:
        raise RuntimeError(
            f"The run is finished, but {len(failed)} of its evaluations failed, the "
            f"last at step {failed[-1]['step']}: {failed[-1]['error']}"
        )
    return float(history[-1][measure])


def _finish_wandb(
    loggers: Sequence[Logger], rows: Mapping[str, Mapping[str, Any]], curve: Path
) -> None:
    """Give W&B the last results, and close its run; all else is in the curves."""
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            import wandb

            logger.experiment.log({"curve": wandb.Image(str(curve))})
            for name, row in rows.items():
                measure = measure_of(row)
                logger.experiment.summary[f"{name}_{measure}"] = row[measure]
            logger.experiment.finish()
