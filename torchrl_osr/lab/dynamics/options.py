"""Options of dynamics models and of the roll-outs in them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torchrl_osr.lab.dynamics.conditional_vae import ConditionalVAE
from torchrl_osr.lab.dynamics.ensemble import DynamicsEnsemble
from torchrl_osr.lab.dynamics.rollout_buffer import check_real_ratio
from torchrl_osr.lab.dynamics.termination import Termination, never, termination


@dataclass
class DynamicsOptions:
    """A model of the dynamics, and what the policy learns from its roll-outs.

    Attributes:
        use: train a model, and the policy on its roll-outs besides the data.
        num_networks: networks of the ensemble.
        num_elites: how many of them are rolled out, the best on held-out rows.
        num_cells: width of each hidden layer.
        lr: learning rate of the model.
        batch_size: rows of a gradient step, for each network.
        steps: gradient steps of the model; the weights of its best evaluation are
            taken.
        vae_num_cells: width of each hidden layer of the conditional autoencoder of
            loss=sdc or dynamics=reverse.
        vae_steps: gradient steps of that autoencoder, with lr and batch_size.
        path: a trained model to take, dynamics.safetensors of a run with the same data;
            null for one of the same settings in the cache, or a new one.
        terminations: auto for the rule by which the task ends, never for tasks that a
            time limit alone ends.
        reverse_policy: actions with which a reverse model rolls out from the data's
            states to where they came from: cvae, those of a conditional autoencoder of
            the data; uniform, random ones; null for no reverse model: the policy rolls
            out forwards.
        adversarial_steps: gradient steps, before each further roll-out, by which the
            model is trained on the data and against the policy; 0 for none.
        adversarial_weight: of the policy's advantage in that training.
        adversarial_lr: learning rate of that training.
        rollout_steps: steps of a roll-out.
        rollout_starts: states of the data that roll-outs start from, each time.
        disturbed_steps: roll-outs begin after at most so many random actions in the
            model; 0 for the data's states themselves.
        action_noise: of the policy's actions in roll-outs; each row draws its standard
            deviation between 0 and this. For policies that are deterministic.
        rollout_interval: gradient steps of the policy between roll-outs.
        generations: number of newest roll-outs that are trained on.
        real_ratio: share of real rows in a batch of the policy's; with 1 nothing is
            imagined.
        penalty: factor of the model's uncertainty, in the task's own units, that
            imagined rewards lose.
        unknown: what becomes of rows on which the elites disagree more than on held-out
            ones: refuse leaves them out, halt ends the task there, take does nothing.
        known_share: share of the held-out rows that count as known in that.
        published: settings by data set or task, where a method has them.
    """

    use: bool = False
    num_networks: int = 7
    num_elites: int = 5
    num_cells: list[int] = field(default_factory=lambda: [200, 200, 200, 200])
    lr: float = 0.001
    batch_size: int = 256
    steps: int = 40_000
    vae_num_cells: list[int] = field(default_factory=lambda: [750, 750])
    vae_steps: int = 100_000
    path: str | None = None
    terminations: str = "auto"
    reverse_policy: str | None = None
    adversarial_steps: int = 0
    adversarial_weight: float = 0.0003
    adversarial_lr: float = 0.0003
    rollout_steps: int = 5
    rollout_starts: int = 50_000
    disturbed_steps: int = 0
    action_noise: float = 0.0
    rollout_interval: int = 1000
    generations: int = 5
    real_ratio: float = 0.05
    penalty: float = 0.0
    unknown: str = "refuse"
    known_share: float = 1.0
    published: dict[str, Any] = field(default_factory=dict)

    def ensemble(self, observation_size: int, action_size: int) -> DynamicsEnsemble:
        """Build an untrained ensemble."""
        return DynamicsEnsemble(
            observation_size,
            action_size,
            num_networks=self.num_networks,
            num_elites=self.num_elites,
            num_cells=list(self.num_cells),
        )

    def transition_vae(self, observation_size: int) -> ConditionalVAE:
        """Build an untrained model of the states that follow a state in the data."""
        return ConditionalVAE(
            observation_size,
            observation_size,
            condition_key="observation",
            target_key=("next", "observation"),
            change=True,
            num_cells=list(self.vae_num_cells),
        )

    def reverse_vae(self, observation_size: int, action_size: int) -> ConditionalVAE:
        """Build an untrained model of the actions that lead to a state in the data."""
        return ConditionalVAE(
            observation_size,
            action_size,
            condition_key=("next", "observation"),
            target_key="action",
            latent_bound=0.5,
            num_cells=list(self.vae_num_cells),
        )

    def termination(self, env_id: str) -> Termination:
        """Return the rule that ends roll-outs; raise a ValueError if none is known."""
        return never if self.terminations == "never" else termination(env_id)

    def check(self, env_id: str, *, batch_size: int, gamma: float) -> None:
        """Raise a ValueError if the options contradict each other or the task.

        Args:
            env_id: Gymnasium id of the task.

        Keyword Args:
            batch_size: rows of a batch for the policy.
            gamma: discount factor.
        """
        self.ensemble(1, 1)
        if self.real_ratio == 1:
            return
        self.termination(env_id)
        check_real_ratio(self.real_ratio, batch_size)
        if self.disturbed_steps and self.reverse_policy:
            raise ValueError(
                f"dynamics.disturbed_steps={self.disturbed_steps} needs a forward "
                "model. Take dynamics=ensemble, or set it to 0."
            )
        if self.unknown == "halt" and self.reverse_policy:
            raise ValueError(
                "dynamics.unknown=halt needs a forward model. Take refuse or take."
            )
        if self.unknown == "halt" and gamma == 1:
            raise ValueError(
                "dynamics.unknown=halt needs optim.gamma below 1: the value of a "
                "state that repeats its reward for ever is infinite."
            )
