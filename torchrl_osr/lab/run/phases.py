"""The phases of a run: its inverse dynamics model is trained, then its policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch.nn import Parameter
from torch.optim.lr_scheduler import LambdaLR
from torchrl.envs import ObservationNorm
from torchrl.record.loggers import Logger
from torchrl.trainers import LRSchedulerHook

from torchrl_osr import StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.lab.data.rows import take_multi_step
from torchrl_osr.lab.dynamics import ModelAdversary, RolloutReplayBuffer, training
from torchrl_osr.lab.evaluation import (
    EpisodeEvaluator,
    describe_inverse_dynamics,
    deterministic_policy,
    inverse_dynamics_report,
    measure_of,
    summarize,
)
from torchrl_osr.lab.run import run_folder
from torchrl_osr.lab.run.build import Learner, dynamics_options, references_of
from torchrl_osr.lab.run.training_data import TrainingData, model_data
from torchrl_osr.trainers import (
    OfflineTrainer,
    SoftUpdate,
    WeightAverage,
    largest_value,
    learning_rates,
)

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes

NewTrainer = partial[OfflineTrainer]
"""Makes a phase's trainer of a loss, an optimizer and what is the phase's own."""


def trainer_maker(
    cfg: DictConfig,
    data: TrainingData,
    components: Mapping[str, Any],
    loggers: Sequence[Logger],
    autocast: torch.dtype | None,
) -> NewTrainer:
    """What all phases have in common, as the function that makes their trainers.

    One step of a trainer: sample a batch, compute the losses, go backward on their sum,
    step the optimizer, move the target networks; log, evaluate and write a checkpoint
    at their intervals.
    """
    return partial(
        OfflineTrainer,
        replay_buffer=data.buffer,
        components=components,
        loggers=loggers,
        log_interval=cfg.trainer.log_interval,
        checkpoint_interval=cfg.trainer.checkpoint_interval,
        checkpoints_kept=cfg.trainer.checkpoints_kept,
        progress=cfg.trainer.progress,
        autocast_dtype=autocast,
        record=cfg.trainer.record,
        compile=cfg.trainer.compile,
        cudagraph=cfg.trainer.cudagraph,
    )


def adam_of(cfg: DictConfig) -> Callable[..., torch.optim.Optimizer]:
    """The optimizer of all phases, as a function of parameters."""
    return partial(torch.optim.Adam, fused=True, capturable=cfg.trainer.cudagraph)


def train_inverse_dynamics(
    cfg: DictConfig,
    folder: Path,
    data: TrainingData,
    model: ProbabilisticTensorDictSequential,
    new_trainer: NewTrainer,
) -> None:
    """Train a run's model: which action leads from a perturbed state to the next?

    Its last numbers are printed, and left in ``inverse_dynamics.json``.
    """
    loss = instantiate(cfg.inverse_dynamics.loss, _partial_=True)(model)
    trainer = new_trainer(
        loss,
        adam_of(cfg)(loss.parameters(), lr=cfg.optim.inverse_dynamics_lr),
        total_steps=cfg.trainer.inverse_dynamics_steps,
        folder=folder / "checkpoint" / "inverse_dynamics",
        seed=cfg.seed,
        evaluate=lambda: inverse_dynamics_report(model, data.held_out),
        metric=("nll", "min"),
        eval_interval=cfg.trainer.inverse_dynamics_steps,
        description="inverse_dynamics",
    )
    _stop_if_removed(trainer, folder)
    if cfg.inverse_dynamics.shuffle_next:
        trainer.register_op("process_optim_batch", _shuffle_next)
    trainer.train()
    write_json(folder / "inverse_dynamics.json", trainer.history[-1])
    print(describe_inverse_dynamics(trainer.history[-1]))


def train_dynamics(
    cfg: DictConfig,
    folder: Path,
    data: TrainingData,
    learner: Learner,
    perturbation: StatePerturbation,
    new_trainer: NewTrainer,
) -> tuple[RolloutReplayBuffer | None, ModelAdversary | None]:
    """Train a run's models of the dynamics, see ``lab/dynamics/training.py``."""
    names = "device", "precision", "matmul_precision", "compile"
    phase = training.Phase(
        folder,
        new_trainer,
        adam_of(cfg),
        cfg.seed,
        name=f"{cfg.env.name}-{cfg.data.source}",
        arithmetic={name: cfg.trainer[name] for name in names},
    )
    return training.train_dynamics(
        dynamics_options(cfg),
        model_data(cfg, data),
        learner.objective,
        learner.actor,
        phase,
        batch_size=cfg.trainer.batch_size,
        gamma=cfg.optim.gamma,
        n_steps=cfg.optim.n_steps,
        transform=perturbation,
    )


def train_policy(
    cfg: DictConfig,
    folder: Path,
    data: TrainingData,
    learner: Learner,
    imagined: RolloutReplayBuffer | None,
    adversary: ModelAdversary | None,
    new_trainer: NewTrainer,
    *,
    played: bool,
) -> OfflineTrainer:
    """Train the policy, by the critics and frozen models; its trainer, at the end.

    Batches are ``imagined`` ones in part, if there are any; the ``adversary`` trains
    the model of the dynamics on. It is evaluated if it can be ``played``.
    """
    actor, _, loss, objective = learner
    critics, policy = _parameters_of(learner)
    optimizer, schedule = _optimizer_of(cfg, critics, policy)
    targets = None
    if critics and loss.delay_qvalue:  # cloning has no critics
        targets = SoftUpdate(loss, tau=cfg.optim.tau)
    # What is played, now and by all other commands.
    average = WeightAverage(actor, cfg.optim.policy_average)
    limit = largest_value(data.largest_reward, cfg.optim.gamma)
    components = {"schedule": schedule, "policy_average": average.network}
    if adversary is not None:  # before the roll-outs, which are of a copy of it
        components["adversary"] = adversary
    if imagined is not None:
        components["imagined"] = imagined
    if imagined is None and cfg.optim.n_steps > 1:
        data.buffer.append_transform(take_multi_step)
    with ExitStack() as opened:
        evaluate = None
        if played:
            episodes = EpisodeEvaluator(
                cfg.env.id,
                num_episodes=cfg.trainer.eval_episodes,
                seed=EVALUATION_SEED,
                device=cfg.trainer.device,
            )
            opened.enter_context(closing(episodes))
            evaluate = partial(
                _evaluation, cfg, episodes, average.network, actor, data.norm
            )
        trainer = new_trainer(
            objective,
            optimizer,
            replay_buffer=data.buffer if imagined is None else imagined,
            components=new_trainer.keywords["components"] | components,
            total_steps=cfg.trainer.steps,
            folder=folder / "checkpoint" / "policy",
            seed=cfg.seed + 1,
            target_net_updater=targets,
            policy_delay=cfg.optim.policy_delay,
            policy_params=policy,
            evaluate=evaluate,
            metric=("return" if references_of(cfg) is None else "score", "max"),
            eval_interval=cfg.trainer.eval_interval,
            description="policy",
            value_limits={"pred_value": limit, "target_value": limit},
        )
        _stop_if_removed(trainer, folder)
        if imagined is not None:
            log_both = partial(_log_imagined, trainer, imagined, adversary)
            trainer.register_op("post_steps", log_both)
        LRSchedulerHook(schedule, interval="optim").register(trainer)
        trainer.register_op("post_optim", lambda: average.update(trainer.step))
        if hasattr(loss, "decay_uncertainty"):
            trainer.register_op("post_optim", loss.decay_uncertainty)
        if cfg.perturbation.adversary is not None:
            attack = instantiate(cfg.perturbation.adversary)
            trainer.register_op("process_optim_batch", partial(attack, loss))
        trainer.train()
    return trainer


def _stop_if_removed(trainer: OfflineTrainer, folder: Path) -> None:
    """Look at each log entry for the folder: in a removed one nothing would be kept."""
    trainer.register_op("post_steps", partial(run_folder.check_ours, folder))


def _parameters_of(learner: Learner) -> tuple[list[Parameter], list[Parameter]]:
    """Parameters of the critics, if there are any, and of all else that is trained."""
    loss, names = learner.loss, ("qvalue_network_params", "value_network_params")
    networks = [getattr(loss, name) for name in names if hasattr(loss, name)]
    critics = [each for network in networks for each in network.parameters()]
    known = set(critics)
    rest = [each for each in learner.objective.parameters() if each not in known]
    return critics, rest


def _optimizer_of(
    cfg: DictConfig, critics: list[Parameter], policy: list[Parameter]
) -> tuple[torch.optim.Optimizer, LambdaLR]:
    """Adam with a learning rate and a schedule for critics and policy each."""
    trained = [
        (critics, cfg.optim.qvalue_lr, cfg.optim.qvalue_schedule),
        (policy, cfg.optim.actor_lr, cfg.optim.actor_schedule),
    ]
    trained = [each for each in trained if each[0]]
    groups = [{"params": params, "lr": rate} for params, rate, _ in trained]
    optimizer = adam_of(cfg)(groups)
    kinds = [kind for *_, kind in trained]
    return optimizer, learning_rates(optimizer, kinds, cfg.trainer.steps)


def _evaluation(
    cfg: DictConfig,
    episodes: EpisodeEvaluator,
    average: ProbabilisticTensorDictSequential,
    actor: ProbabilisticTensorDictSequential,
    norm: ObservationNorm,
) -> dict[str, Any]:
    """Results of the averaged policy; of the last weights the mean, if they differ."""
    references = references_of(cfg)
    results = summarize(episodes(deterministic_policy(average, norm)), references)
    if cfg.optim.policy_average < 1:
        last = summarize(episodes(deterministic_policy(actor, norm)), references)
        measure = measure_of(last)
        results[f"{measure}_of_last_weights"] = last[measure]
    return results


def _log_imagined(
    trainer: OfflineTrainer,
    imagined: RolloutReplayBuffer,
    adversary: ModelAdversary | None,
) -> None:
    """Log what the rows are like that the policy learns from besides the data."""
    of_model = {} if adversary is None else adversary.metrics
    for name, value in (imagined.metrics() | of_model).items():
        for logger in trainer.loggers:
            logger.log_scalar(f"policy/{name}", value, step=trainer.step)


def _shuffle_next(batch: TensorDict) -> TensorDict:
    """Give every row the next state of another: an ablation of the model."""
    key = ("next", "observation")
    return batch.set(key, batch[key].roll(1, 0))  # the rows came in random order
