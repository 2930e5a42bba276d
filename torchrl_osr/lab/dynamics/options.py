"""Options of dynamics models, and the data that they learn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from tensordict import TensorDict
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, Storage

from torchrl_osr._checks import check_choice
from torchrl_osr.lab.dynamics.body import Body
from torchrl_osr.lab.dynamics.models import DynamicsEnsemble


@dataclass(frozen=True)
class ModelData:
    """The data of a run as its models see them, and the scale of rewards and values."""

    storage: Storage  # rows to train on
    held_out: TensorDict  # rows to evaluate models on
    loc: Tensor  # observations are (s - loc) / scale
    scale: Tensor
    reward_scale: float  # factor of the task's own rewards
    gamma: float  # discount factor
    env_id: str | None
    seed: int
    action_low: Sequence[float] | float = -1.0  # of the environment
    action_high: Sequence[float] | float = 1.0

    def buffer(self, batch_size: int | None = None) -> ReplayBuffer:
        """Return a buffer of the rows to train on, without transforms."""
        return ReplayBuffer(
            storage=self.storage, writer=ImmutableDatasetWriter(), batch_size=batch_size
        )


@dataclass
class DynamicsOptions:
    """Options of a run's dynamics models and of the policy's rollouts in them."""

    use: bool = False  # train a model, and the policy on its rollouts
    # Defaults of the ensemble are MOPO's.
    num_networks: int = 7  # number of networks
    num_elites: int = 5  # networks used for rollouts, the best on held-out rows
    # width of each hidden layer of the networks
    num_cells: list[int] = field(default_factory=lambda: [200, 200, 200, 200])
    xml: str | None = None  # file of the robot's body, MJCF, for dynamics=grey_box
    frame_skip: int = 1  # physics steps of an action in it
    lr: float = 1e-3  # learning rate of the model
    batch_size: int = 256  # rows of a gradient step, for each network
    steps: int = 40_000  # gradient steps of the model; the best evaluation counts
    # width of each hidden layer of the autoencoder, which loss=sdc trains
    vae_num_cells: list[int] = field(default_factory=lambda: [750, 750])
    vae_steps: int = 100_000  # gradient steps of the autoencoder
    # Rollouts.
    real_ratio: float = 0.05  # share of recorded rows in a batch; 1: no rollouts
    rollout_steps: int = 5  # steps of a rollout
    rollout_starts: int = 50_000  # number of rollouts at a time
    perturbed_start_steps: int = 0  # largest number of random actions before a rollout
    action_noise: float = 0.0  # largest standard deviation of noise on actions
    rollout_interval: int = 1000  # gradient steps between rollouts
    generations: int = 5  # number of newest rollouts that batches are drawn from
    penalty: float = 0.0  # weight of the model's uncertainty in rewards
    unknown: str = "halt"  # rows the model does not know: "halt" (end there) or "take"
    known_share: float = 1.0  # share of held-out rows that count as known
    # RAMBO's training of the model against the policy, before each further rollout.
    adversarial_steps: int = 0  # gradient steps against the policy
    adversarial_weight: float = 3e-4  # weight of the adversarial term
    adversarial_lr: float = 3e-4  # learning rate of the adversarial steps

    def ensemble(self, observation_size: int, action_size: int) -> DynamicsEnsemble:
        """Build an untrained ensemble."""
        names = "num_networks", "num_elites", "num_cells"
        options = {name: getattr(self, name) for name in names}
        return DynamicsEnsemble(observation_size, action_size, **options)

    def body(self, **units: Any) -> Body:
        """Return the body as it is described; ``units`` are options of it."""
        return Body(self.xml or "", self.frame_skip, **units)

    def check(self, *, batch_size: int, gamma: float) -> None:
        """Raise a ValueError if the options contradict each other or the task."""
        check_choice("dynamics.unknown", self.unknown, ("halt", "take"))
        rolled_out, real = self.real_ratio != 1, round(self.real_ratio * batch_size)
        if self.xml == "":
            why = "xml is not given: a grey box needs the robot's MJCF file"
        elif not 1 <= self.num_elites <= self.num_networks:
            why = f"num_elites={self.num_elites} must be between 1 and num_networks"
        elif rolled_out and not 0 < real < batch_size:
            why = f"real_ratio={self.real_ratio}: {real} of {batch_size} rows are real"
        elif rolled_out and self.unknown == "halt" and gamma == 1:
            why = "unknown=halt needs optim.gamma below 1"
        elif rolled_out and self.unknown == "halt" and self.num_elites == 1:
            why = "unknown=halt needs num_elites above 1: one never disagrees"
        else:
            return
        raise ValueError(f"dynamics.{why}.")
