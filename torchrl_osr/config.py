"""The typed schema of the examples' configuration.

Types and meanings are here, values in ``conf/``. Importing this module changes nothing;
:func:`register` makes the schema known to Hydra, which then refuses a mistyped key or a
value of the wrong type by name.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

# File systems allow 255 bytes, and temporary names beside it need some of them.
MAX_FOLDER_NAME = 200


@dataclass
class EnvConfig:
    """Which task.

    Attributes:
        name: short name, as behaviour policies and reference scores know it.
        id: the Gymnasium id that is evaluated.
    """

    name: str = MISSING
    id: str = MISSING


@dataclass
class DataConfig:
    """Which data set, rolled out locally from the packaged behaviour policies.

    Attributes:
        level: random, medium, medium-replay, medium-expert or expert.
        num_transitions: rows of the data set.
        seed: of the rollouts.
        held_out: share of the rows kept from training to judge the inverse dynamics.
    """

    level: str = MISSING
    num_transitions: int = MISSING
    seed: int = MISSING
    held_out: float = MISSING


@dataclass
class NetworkConfig:
    """Actor, critics and inverse dynamics model.

    Attributes:
        num_cells: width of each hidden layer.
        num_qvalue_nets: number of critics.
        layer_norm: in the critics; steadier, but not in the paper.
    """

    num_cells: list[int] = MISSING
    num_qvalue_nets: int = MISSING
    layer_norm: bool = MISSING


@dataclass
class PerturbationConfig:
    """The noise of the mixed data set, see ``StatePerturbation``.

    Attributes:
        std: in units of each observation entry's standard deviation in the data.
        noise: gaussian or uniform.
    """

    std: float = MISSING
    noise: str = MISSING


@dataclass
class OSRLossConfig:
    """Keywords of ``OSRLoss``; its docstring has their meaning.

    Attributes:
        recovery_weight: lambda; 0 is CQL.
        min_q_weight: alpha.
        num_random: K, sampled actions of each of the three kinds.
        temperature: of the log-sum-exp.
        loss_function: l2, l1 or smooth_l1.
        alpha_init: initial entropy temperature.
        fixed_alpha: keep it.
        deactivate_vmap: critics one by one, which is faster on a CPU.
    """

    recovery_weight: float = MISSING
    min_q_weight: float = MISSING
    num_random: int = MISSING
    temperature: float = MISSING
    loss_function: str = MISSING
    alpha_init: float = MISSING
    fixed_alpha: bool = MISSING
    deactivate_vmap: bool = MISSING


@dataclass
class OptimConfig:
    """Adam's learning rates and what moves with them.

    Attributes:
        actor_lr: policy and entropy temperature.
        qvalue_lr: critics.
        inverse_dynamics_lr: inverse dynamics model.
        gamma: discount factor.
        tau: share of the critics that flows into their targets at each step.
    """

    actor_lr: float = MISSING
    qvalue_lr: float = MISSING
    inverse_dynamics_lr: float = MISSING
    gamma: float = MISSING
    tau: float = MISSING


@dataclass
class TrainerConfig:
    """How long, how often, where.

    Attributes:
        batch_size: rows of a gradient step.
        inverse_dynamics_steps: gradient steps of the first phase.
        steps: gradient steps of the policy phase.
        log_interval: steps between log entries.
        eval_interval: steps between evaluations.
        eval_episodes: complete episodes of an evaluation.
        checkpoint_interval: steps between checkpoints.
        num_threads: torch threads; several fight where the machine is shared.
        device: cpu or cuda.
        progress: progress bars, when on a terminal.
    """

    batch_size: int = MISSING
    inverse_dynamics_steps: int = MISSING
    steps: int = MISSING
    log_interval: int = MISSING
    eval_interval: int = MISSING
    eval_episodes: int = MISSING
    checkpoint_interval: int = MISSING
    num_threads: int = MISSING
    device: str = MISSING
    progress: bool = MISSING


@dataclass
class LoggerConfig:
    """Where numbers go besides the CSV files, which are always written.

    Attributes:
        kind: csv (nothing else), tensorboard or wandb.
        project: W&B project.
        mode: W&B mode: offline, online or disabled.
    """

    kind: str = MISSING
    project: str = MISSING
    mode: str = MISSING


@dataclass
class OfflineOSRConfig:
    """Everything that ``examples/offline_osr.py`` reads.

    Attributes:
        seed: of networks, sampling, noise and evaluation episodes.
        resume: folder of a killed run to continue.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    loss: OSRLossConfig = field(default_factory=OSRLossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = MISSING
    resume: str | None = None


def register() -> None:
    """Make the schema known to Hydra as ``offline_osr_schema``.

    And two resolvers: ``run_dir``, by which ``resume=folder`` becomes the run's folder,
    and ``job_dir``, which names a sweep's folders by number and overrides.
    """
    ConfigStore.instance().store(name="offline_osr_schema", node=OfflineOSRConfig)
    OmegaConf.register_new_resolver(
        "run_dir", lambda resume, fresh: resume or fresh, replace=True
    )
    OmegaConf.register_new_resolver(
        "job_dir",
        lambda number, overrides: f"{number}_{overrides}"[:MAX_FOLDER_NAME],
        replace=True,
    )
