"""The phases of a run: its inverse dynamics model is trained, then its policy."""

from __future__ import annotations

import math
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
from torch import Tensor
from torch.nn import Parameter
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel
from torchrl.envs import ObservationNorm
from torchrl.objectives import LossModule, SoftUpdate, TargetNetUpdater
from torchrl.record.loggers import Logger

from torchrl_osr import StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.fast import fast_update
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
from torchrl_osr.trainers import Evaluation, OfflineTrainer, largest_value

EVALUATION_SEED = 10_000  # far from the seeds of the data's episodes

NewTrainer = Callable[..., OfflineTrainer]
"""Makes a phase's trainer of a loss, an optimizer and what is the phase's own."""


def trainer_maker(
    cfg: DictConfig,
    folder: Path,
    data: TrainingData,
    components: Mapping[str, Any],
    loggers: Sequence[Logger],
    autocast: torch.dtype | None,
) -> NewTrainer:
    """Return the function that makes the trainers of all phases.

    One step of a trainer: sample a batch, compute the losses, go backward on their sum,
    step the optimizer, move the target networks; log, write a checkpoint and evaluate
    at their intervals.
    """

    def new_trainer(
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target_updater: TargetNetUpdater | None = None,
        *,
        policy_delay: int = 1,
        policy_params: Sequence[Parameter] = (),
        **options: Any,
    ) -> OfflineTrainer:
        if cfg.trainer.compile:
            loss.compile()
        update = fast_update(
            loss,
            optimizer,
            target_updater,
            policy_delay=policy_delay,
            policy_params=policy_params,
            autocast_dtype=autocast,
            trace=cfg.trainer.record,
        )
        # In a folder that was removed, nothing would be kept.
        removed = ("post_steps", partial(run_folder.check_ours, folder))
        shared = {
            "replay_buffer": data.buffer,
            "loggers": loggers,
            "log_interval": cfg.trainer.log_interval,
            "checkpoint_interval": cfg.trainer.checkpoint_interval,
            "checkpoints_kept": cfg.trainer.checkpoints_kept,
            "progress": cfg.trainer.progress,
        }
        own = {
            "components": {**components, **options.pop("components", {})},
            "hooks": [removed, *options.pop("hooks", [])],
        }
        return OfflineTrainer(update, **(shared | own | options))

    return new_trainer


def adam_of(cfg: DictConfig) -> Callable[..., torch.optim.Optimizer]:
    """The optimizer of all phases, as a function of parameters."""
    return partial(torch.optim.Adam, fused=True)


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
        evaluation=Evaluation(
            lambda: inverse_dynamics_report(model, data.held_out),
            cfg.trainer.inverse_dynamics_steps,
            "nll",
            "min",
        ),
        description="inverse_dynamics",
        hooks=[("process_optim_batch", _shuffle_next)]
        * cfg.inverse_dynamics.shuffle_next,
    )
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
    average = AveragedModel(
        actor, multi_avg_fn=partial(_average, share=cfg.optim.policy_average)
    )
    limit = largest_value(data.largest_reward, cfg.optim.gamma)
    components = {"schedule": schedule, "policy_average": average}
    if adversary is not None:  # before the roll-outs, which are of a copy of it
        components["adversary"] = adversary
    if imagined is not None:
        components["imagined"] = imagined
    if imagined is None and cfg.optim.n_steps > 1:
        data.buffer.append_transform(take_multi_step)
    hooks: list[tuple[str, Callable[..., Any]]] = [
        ("post_optim", schedule.step),
        ("post_optim", partial(average.update_parameters, actor)),
    ]
    if imagined is not None:
        hooks.append(
            ("post_steps", lambda: _log_imagined(trainer, imagined, adversary))
        )
    if hasattr(loss, "decay_uncertainty"):
        hooks.append(("post_optim", loss.decay_uncertainty))
    if cfg.perturbation.adversary is not None:
        attack = instantiate(cfg.perturbation.adversary)
        hooks.append(("process_optim_batch", partial(attack, loss)))
    with ExitStack() as opened:
        evaluation = None
        if played:
            episodes = EpisodeEvaluator(
                cfg.env.id,
                num_episodes=cfg.trainer.eval_episodes,
                seed=EVALUATION_SEED,
                device=cfg.trainer.device,
            )
            opened.enter_context(closing(episodes))
            evaluation = Evaluation(
                partial(_evaluation, cfg, episodes, average.module, actor, data.norm),
                cfg.trainer.eval_interval,
                "return" if references_of(cfg) is None else "score",
            )
        trainer = new_trainer(
            objective,
            optimizer,
            targets,
            replay_buffer=data.buffer if imagined is None else imagined,
            hooks=hooks,
            components=components,
            total_steps=cfg.trainer.steps,
            folder=folder / "checkpoint" / "policy",
            seed=cfg.seed + 1,
            policy_delay=cfg.optim.policy_delay,
            policy_params=policy,
            evaluation=evaluation,
            description="policy",
            value_limits={"pred_value": limit, "target_value": limit},
        )
        trainer.train()
    return trainer


@torch.no_grad()
def _average(
    average: list[Tensor], weights: list[Tensor], count: Tensor, share: float
) -> None:
    """Move an exponential average of weights, which forgets its first ones.

    They would stay in it for longer than a short run lasts: until update number
    ``10 / share`` it is of about the last tenth of all updates.
    """
    torch._foreach_lerp_(average, weights, max(share, 10 / (int(count) + 10)))


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

    def cosine(step: int) -> float:
        return 0.5 * (1 + math.cos(math.pi * min(step / cfg.trainer.steps, 1.0)))

    factors = {"cosine": cosine, "constant": lambda _: 1.0}
    return optimizer, LambdaLR(optimizer, [factors[kind] for *_, kind in trained])


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
