"""Training a run: inverse dynamics model, models of the dynamics, policy, report.

``examples/offline_osr.py`` has the same steps for OSR alone, on one page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from hydra.utils import instantiate
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
from torchrl_osr.lab.run.build import make_learner, try_out
from torchrl_osr.lab.run.data import load_training_data
from torchrl_osr.lab.run.folder import Run
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


def train(run: Run) -> float:
    """Train a run, or continue it; return its last score or return, for a sweeper."""
    phases = Phases(run)
    if phases.learner.model is not None:
        phases.train_inverse_dynamics()
    rollouts = phases.train_dynamics() if run.config.dynamics.use else None
    trainer = phases.train_policy(rollouts)
    save_policies(run, phases.learner, phases.data.norm)
    return report(run, phases.data.mean, trainer)


class Phases:
    """The phases of a run's training, and what they share: networks, data, options."""

    def __init__(self, run: Run) -> None:
        self.run, self.config = run, (config := run.config)
        device, self.autocast = prepare_machine(run)
        # Before the data are made: a wrong option costs no time.
        torch.manual_seed(config.seed)
        self.learner = make_learner(config, device)
        if run.simulated:
            try_out(config.env.id)
        self.options = trainer_options(run)
        # Transitions with standardised states. Each batch gets a perturbed state for
        # every state, which is the paper's mixed data set.
        self.data = load_training_data(config, device, self.learner.objective.in_keys)
        self.perturbation = StatePerturbation(config.perturbation.std, seed=config.seed)
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
        update = fast_update(
            loss,
            optimizer,
            target_updater,
            policy_delay=config.optim.policy_delay if policy_params else 1,
            policy_params=policy_params,
            autocast_dtype=self.autocast,
            trace=config.trainer.record,
        )
        kept = {"perturbation": self.perturbation, "observation_norm": data.norm}
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
        write_json(self.run.folder / "inverse_dynamics.json", trainer.history[-1])
        print(describe_inverse_dynamics(trainer.history[-1]))

    def train_dynamics(self) -> RolloutReplayBuffer | None:
        """Train models of the dynamics, see ``lab/dynamics/training.py``."""
        config, data = self.config, self.data
        model_data = ModelData(
            data.buffer.storage,
            data.held_out,
            data.norm.loc,
            data.norm.scale,
            config.data.reward_scale,
            config.optim.gamma,
            config.env.id,
            config.seed,
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


def _log_rollouts(trainer: OfflineTrainer, rollouts: RolloutReplayBuffer) -> None:
    """Log numbers of the synthetic rows."""
    for name, value in rollouts.metrics().items():
        for logger in trainer.loggers:
            logger.log_scalar(f"policy/{name}", value, step=trainer.step)
