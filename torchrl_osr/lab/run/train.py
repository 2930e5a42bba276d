"""Training a run: inverse dynamics model, models of the dynamics, policy, report.

``examples/offline_osr.py`` has the same steps for OSR alone, on one page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from hydra.utils import instantiate
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch.nn import Parameter
from torchrl.objectives import LossModule, SoftUpdate, TargetNetUpdater

from torchrl_osr import StatePerturbation
from torchrl_osr._files import write_json
from torchrl_osr.fast import fast_update
from torchrl_osr.lab.data.rows import take_multi_step
from torchrl_osr.lab.dynamics import ModelData, RolloutReplayBuffer, training
from torchrl_osr.lab.evaluation import (
    describe_inverse_dynamics,
    inverse_dynamics_report,
)
from torchrl_osr.lab.run.build import Learner, make_learner, try_out
from torchrl_osr.lab.run.data import TrainingData, load_training_data
from torchrl_osr.lab.run.folder import Run
from torchrl_osr.lab.run.load import CHECKPOINTS
from torchrl_osr.lab.run.parts import (
    adam,
    averaged,
    evaluation,
    optimizer_of,
    prepare_machine,
    report,
    save_policies,
    trainer_options,
)
from torchrl_osr.trainers import Evaluation, Hook, OfflineTrainer, divergence_warning

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
    options = trainer_options(run)

    # Transitions with standardised states. Each batch gets a perturbed state for every
    # state, which is the paper's mixed data set.
    data = load_training_data(config, device, learner.objective.in_keys)
    perturbation = StatePerturbation(config.perturbation.std, seed=config.seed)
    data.buffer.append_transform(perturbation)

    new_trainer = trainer_maker(run, data, perturbation, options, autocast)
    if learner.model is not None:
        train_inverse_dynamics(run, data, learner.model, new_trainer)
    rollouts = None
    if config.dynamics.use:
        rollouts = train_dynamics(run, data, learner, perturbation, new_trainer)
    trainer = train_policy(run, data, learner, rollouts, new_trainer)
    save_policies(run, learner, data.norm)
    return report(run, data.mean, trainer)


def trainer_maker(
    run: Run,
    data: TrainingData,
    perturbation: StatePerturbation,
    shared: Mapping[str, Any],
    autocast: torch.dtype | None,
) -> NewTrainer:
    """Return a function that makes a phase's trainer, with what all phases share."""
    config = run.config
    kept = {"perturbation": perturbation, "observation_norm": data.norm}

    def new_trainer(
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target_updater: TargetNetUpdater | None = None,
        *,
        policy_params: Sequence[Parameter] = (),
        components: Mapping[str, Any] | None = None,
        hooks: Sequence[Hook] = (),
        **own: Any,
    ) -> OfflineTrainer:
        if config.trainer.compile:
            loss.compile()
        update = fast_update(
            loss,
            optimizer,
            target_updater,
            policy_delay=config.optim.policy_delay if policy_params else 1,
            policy_params=policy_params,
            autocast_dtype=autocast,
            trace=config.trainer.record,
        )
        return OfflineTrainer(
            update,
            hooks=hooks,
            components=kept | dict(components or {}),
            **{"replay_buffer": data.buffer, **shared, **own},
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
) -> RolloutReplayBuffer | None:
    """Train models of the dynamics, see ``lab/dynamics/training.py``."""
    config = run.config
    model_data = ModelData(
        data.buffer.storage,
        data.held_out,
        data.pieces,
        data.norm.loc,
        data.norm.scale,
        config.data.reward_scale,
        config.data.reward_shift,
        config.optim.gamma,
        config.env.id,
        config.seed,
    )

    def fit(name: str, loss: LossModule, params: Any, **options: Any) -> OfflineTrainer:
        trainer = new_trainer(
            loss,
            adam(params, lr=config.dynamics.lr),
            folder=run.folder / "checkpoint" / name,
            seed=config.seed,
            description=name,
            **options,
        )
        trainer.train()
        return trainer

    return training.train_dynamics(
        config.dynamics,
        model_data,
        learner.objective,
        learner.actor,
        fit,
        run.folder,
        batch_size=config.trainer.batch_size,
        n_steps=config.optim.n_steps,
        transform=perturbation,
    )


def train_policy(
    run: Run,
    data: TrainingData,
    learner: Learner,
    rollouts: RolloutReplayBuffer | None,
    new_trainer: NewTrainer,
) -> OfflineTrainer:
    """Train the policy, by the critics and frozen models; return its trainer.

    Batches are from ``rollouts`` in part, if there are any. It is evaluated if its
    environment is simulated.
    """
    config, optim = run.config, run.config.optim
    actor, _, loss, objective = learner
    critics, policy = _parameters_of(learner)
    optimizer, schedule = optimizer_of(run, critics, policy)
    targets = None
    if critics:  # cloning has none
        targets = SoftUpdate(loss, tau=optim.tau)
    average = averaged(actor, optim.policy_average)
    components = {"schedule": schedule, "policy_average": average}
    hooks: list[Hook] = [
        divergence_warning(data.largest_reward, optim.gamma),
        ("post_optim", schedule.step),
        ("post_optim", partial(average.update_parameters, actor)),
    ]
    if hasattr(loss, "decay_uncertainty"):
        hooks.append(("post_optim", loss.decay_uncertainty))
    if config.perturbation.adversary is not None:
        attack = instantiate(config.perturbation.adversary)
        hooks.append(("process_optim_batch", partial(attack, loss)))
    if rollouts is not None:
        components["rollouts"] = rollouts
        hooks.append(("post_steps", lambda: _log_rollouts(trainer, rollouts)))
    elif optim.n_steps > 1:
        data.buffer.append_transform(take_multi_step)
    with evaluation(run, data.norm, average) as evaluate:
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
        )
        trainer.train()
    return trainer


def _parameters_of(learner: Learner) -> tuple[list[Parameter], list[Parameter]]:
    """Parameters of the critics, if there are any, and of all else that is trained."""
    loss, names = learner.loss, ("qvalue_network_params", "value_network_params")
    networks = [getattr(loss, name) for name in names if hasattr(loss, name)]
    critics = [each for network in networks for each in network.parameters()]
    known = set(critics)
    rest = [each for each in learner.objective.parameters() if each not in known]
    return critics, rest


def _log_rollouts(trainer: OfflineTrainer, rollouts: RolloutReplayBuffer) -> None:
    """Log numbers of the synthetic rows."""
    for name, value in rollouts.metrics().items():
        for logger in trainer.loggers:
            logger.log_scalar(f"policy/{name}", value, step=trainer.step)


def _shuffle_next(batch: TensorDict) -> TensorDict:
    """Give every row the next state of another: an ablation of the model."""
    key = ("next", "observation")
    return batch.set(key, batch[key].roll(1, 0))  # the rows came in random order
