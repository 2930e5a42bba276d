"""Typed schema of the configuration: every key, its type and its meaning.

Hydra refuses a mistyped key or a value of the wrong type. Values are in ``conf/``. The
options of a loss are declared in its constructor: :func:`schema_of` reads them.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, field, make_dataclass
from enum import StrEnum
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from hydra.utils import get_class
from omegaconf import MISSING, DictConfig, OmegaConf

from torchrl_osr import objectives
from torchrl_osr.lab import losses
from torchrl_osr.lab.data.environment import environment_name
from torchrl_osr.lab.data.sources import RECORDED
from torchrl_osr.lab.dynamics import DynamicsOptions

LOSSES = {
    name: getattr(package, name)
    for package in (objectives, losses)
    for name in package.__all__
    if name not in ("ActorCriticLoss", "WithRecovery")
}
"""Losses that a configuration can name."""


@dataclass
class EnvConfig:
    """The task."""

    # Gymnasium id; package:Name-v0 imports the package first; null: no simulator
    id: str | None = MISSING
    name: str = "${environment_name:${env.id}}"  # short name of the task
    random_return: float | None = None  # mean return of a random policy
    expert_return: float | None = None  # mean return of an expert; null: raw returns
    # Read from the environment or the log, and kept with the run.
    action_low: list[float] | None = None  # lowest actions; null: discrete
    action_high: list[float] | None = None  # highest actions; null: discrete
    observation_size: int | None = None  # number of observation entries
    action_size: int | None = None  # number of action entries, or of discrete actions

    @property
    def discrete(self) -> bool:
        """Whether an action is one of ``action_size``; needs the sizes."""
        return self.action_size is not None and self.action_low is None


@dataclass
class ColumnsConfig:
    """Names of a log's columns; null for the usual names, see docs/your_data.md."""

    observation: Any = None  # a name, a pattern such as obs_*, or a list of names
    action: Any = None  # a name, a pattern, or a list of names
    reward: str | None = None  # name of the column
    terminated: Any = None  # name of the column; false: nothing ends the task
    truncated: str | None = None  # name of the column
    episode: str | None = None  # name of the column that numbers the episodes
    step: str | None = None  # name of the column that sorts the rows of an episode
    next_observation: Any = None  # a name, a pattern, or a list of names


@dataclass
class DataConfig:
    """The data set: rolled out from packaged behaviour policies, or recorded."""

    # Behaviour policy: random, medium, medium-replay, medium-expert or expert; in a
    # maze diverse, play or umaze. Recorded data: minari, d4rl, lerobot or file.
    source: str = MISSING
    path: Any = None  # recorded data: a file, a folder, a list or a pattern
    columns: Any = field(default_factory=ColumnsConfig)  # or a YAML file with them
    action_bounds: Any = None  # bounds in the log's units; null: the task's
    clip_actions: bool = False  # clip actions outside the bounds; false: refuse them
    missing: str = "error"  # missing values: error, or leave out the row or episode
    download: bool = False  # download the set that path names
    num_transitions: int | None = None  # number of collected rows, default 200,000
    seed: int = 0  # random seed of collection and held-out rows
    random_share: float = 0.0  # share of rows replaced by random data
    held_out: float = 0.02  # share of rows kept to judge models
    standardize: bool = True  # standardise observations
    reward_scale: float = 1.0  # factor of the training rewards
    reward_shift: float = 0.0  # added to the scaled training rewards
    checksum: str | None = None  # of the data; read from them and kept with the run
    observation_names: list[str] | None = None  # of a log, in order; kept with the run


@dataclass
class NetworkConfig:
    """Actor and critics."""

    actor: dict[str, Any] = MISSING  # builder (_target_) and its options
    critic: dict[str, Any] = MISSING  # builder (_target_) and its options
    num_cells: list[int] = MISSING  # width of each hidden layer
    layer_norm: bool = MISSING  # layer normalisation in the critics


@dataclass
class PerturbationConfig:
    """Noise of the mixed data set, see StatePerturbation."""

    std: float = MISSING  # beta, in standard deviations; raw units if not standardised


@dataclass
class InverseDynamicsConfig:
    """The inverse dynamics model and its training."""

    network: dict[str, Any] = MISSING  # builder (_target_) and its options
    loss: Any = MISSING  # options of InverseDynamicsLoss


@dataclass
class OptimConfig:
    """Adam's learning rates and what moves with them."""

    actor_lr: float = MISSING  # learning rate of policy and temperature
    qvalue_lr: float = MISSING  # learning rate of the critics
    inverse_dynamics_lr: float = MISSING  # learning rate of the inverse dynamics model
    gamma: float = MISSING  # discount factor
    n_steps: int = 1  # steps of the n-step returns
    tau: float = MISSING  # step size of the target networks
    policy_delay: int = 1  # critic updates for each policy update
    actor_schedule: str = "constant"  # cosine: actor_lr falls to 0 over the run
    # Weight of the new policy in its average, which is evaluated; 1: no average.
    policy_average: float = 1.0


@dataclass
class TrainerConfig:
    """Length, intervals and hardware. Intervals are in gradient steps."""

    batch_size: int = MISSING  # rows of a gradient step
    inverse_dynamics_steps: int = MISSING  # gradient steps of inverse dynamics model
    steps: int = MISSING  # gradient steps of policy and critics
    log_interval: int = MISSING  # steps between log entries
    eval_interval: int = MISSING  # steps between evaluations
    eval_episodes: int = MISSING  # episodes of an evaluation
    checkpoint_interval: int = MISSING  # steps between checkpoints
    checkpoints_kept: int = MISSING  # number of newest checkpoints kept
    num_threads: int = MISSING  # torch threads; 1 if several runs share a machine
    device: str = MISSING  # cpu, cuda or cuda:1
    precision: str = MISSING  # precision of the losses: float32 or bfloat16
    matmul_precision: str = MISSING  # of matrix products: highest, high or medium
    record: bool = MISSING  # repeat recorded operations: same numbers, faster
    compile: bool = MISSING  # compile the losses
    progress: bool = MISSING  # show progress bars


@dataclass
class LoggerConfig:
    """Loggers besides the CSV files, which are always written."""

    kind: str = MISSING  # csv, tensorboard or wandb
    project: str = MISSING  # W&B project
    mode: str = MISSING  # W&B mode: offline, online or disabled


@dataclass
class TrainConfig:
    """Configuration of ``torchrl-osr train``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    inverse_dynamics: InverseDynamicsConfig = field(
        default_factory=InverseDynamicsConfig
    )
    dynamics: DynamicsOptions = field(default_factory=DynamicsOptions)
    loss: Any = MISSING  # _target_ and options of a loss
    recovery: Any = None  # options of StateRecoveryLoss, added to a loss without one
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    # By data set: rows <env>-<source>[-mixed], <env> or any, for ${by_data:key}.
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    seed: int = MISSING  # random seed of networks, sampling and noise
    resume: str | None = None  # folder of a run to continue, or to extend
    force: bool = False  # continue although settings differ from those of the run
    # Modules of yours that a configuration may import, see docs/extend.md.
    trust: list[str] = field(default_factory=list)


@dataclass
class CheckDataConfig:
    """Configuration of ``torchrl-osr data``."""

    env: EnvConfig = field(default_factory=EnvConfig)  # compared with, if given
    data: DataConfig = field(default_factory=DataConfig)
    progress: bool = MISSING


@dataclass
class CollectConfig:
    """Configuration of ``torchrl-osr collect``."""

    env: EnvConfig = field(default_factory=EnvConfig)
    policy: str = MISSING  # random, a run's folder, or a function: my_package:act
    path: str = MISSING  # log to write
    episodes: int = MISSING  # number of episodes
    noise: float = MISSING  # action noise, in half-widths of the bounds
    seed: int = MISSING  # seed of the first episode
    progress: bool = MISSING
    trust: list[str] = MISSING


@dataclass
class DisturbanceConfig:
    """A disturbance and its kind."""

    kind: str = MISSING  # knock, push and start end; others last the whole episode
    wrap: Any = MISSING  # wrapper of lab.envs, with _target_ and _partial_


@dataclass
class SuiteConfig:
    """A list of disturbances, or a half of the recoverable states."""

    name: str = MISSING  # part of the names of the result files
    disturbances: dict[str, DisturbanceConfig] = field(default_factory=dict)
    half: str | None = None  # of recoverable states: public, held-out or sealed


@dataclass
class MovedConfig:
    """The present place of a run's data."""

    path: Any = None  # as in data.path of the run; null: where they were


@dataclass
class EvaluateConfig:
    """Configuration of ``torchrl-osr evaluate``."""

    checkpoint: str | None = None  # a run's folder, or one checkpoint in it
    sweep: str | None = None  # or a folder: every finished run in or below it
    switching: bool = MISSING  # play the runs of the sweep as one policy
    jobs: int = MISSING  # runs of a sweep evaluated at once
    data: MovedConfig = field(default_factory=MovedConfig)
    suite: SuiteConfig = field(default_factory=SuiteConfig)
    episodes: int = MISSING  # pairs for each checkpoint and disturbance, at least 2
    last: int = MISSING  # number of the run's newest checkpoints
    seed: int = MISSING  # of the first checkpoint's first episode; the next: 1000 more
    force: bool = MISSING  # repeat a finished evaluation
    num_threads: int = MISSING  # torch threads
    progress: bool = MISSING
    trust: list[str] = MISSING


def schema_of(target: type) -> type:
    """Return a dataclass of the options of a loss.

    Its fields are the keyword-only parameters of the class, and of the bases that its
    ``**options`` reach.
    """
    lab = target.__module__.startswith(losses.__name__)
    package = losses.__name__ if lab else "torchrl_osr"
    options: dict[str, tuple[str, Any, Any]] = {
        "_target_": ("_target_", str, f"{package}.{target.__name__}")
    }
    for each in target.__mro__:
        if "__init__" not in vars(each):
            continue
        parameters = inspect.signature(each).parameters
        hints = get_type_hints(vars(each)["__init__"])
        for name, parameter in parameters.items():
            if parameter.kind is parameter.KEYWORD_ONLY:
                option = name, _config_type(hints[name]), parameter.default
                options.setdefault(name, option)
        if not any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
            break
    return make_dataclass(f"{target.__name__}Config", options.values())


def _config_type(annotation: Any) -> Any:
    """Return an annotation that OmegaConf can check: a plain or optional type."""
    if get_origin(annotation) is Literal:
        # A trainer cannot go backward from one loss for each row.
        return StrEnum("choice", [x for x in get_args(annotation) if x != "none"])
    parts = {*get_args(annotation)} - {NoneType} or {annotation}
    return annotation if parts < {bool, int, float, str} else Any


@functools.cache
def register() -> None:
    """Make the schemas of commands and of :data:`LOSSES`, and resolvers, known."""
    store = ConfigStore.instance()
    store.store(name="train_schema", node=TrainConfig)
    store.store(name="check_data_schema", node=CheckDataConfig)
    store.store(name="collect_schema", node=CollectConfig)
    store.store(name="evaluate_schema", node=EvaluateConfig)
    for name, chosen in LOSSES.items():
        store.store(group="schema", name=name, node=schema_of(chosen))
    resolvers: dict[str, Callable[..., Any]] = {
        "environment_name": lambda env_id: environment_name(env_id or "log"),
        # Never that of a task, which has settings and scores.
        "log_name": lambda path: "log-" + re.sub(r"\W+", "-", Path(str(path)).stem),
        "run_dir": _run_dir,
        "method_name": method_name,
        "by_data": by_data,
        # The value of an option that recorded data do not have.
        "rolled_out": lambda value, *, _root_: (
            None if _root_.data.source in RECORDED else value
        ),
        # A part of a folder's name; file systems allow 255 bytes.
        "short": lambda text: re.sub(r"[^\w.-]+", "-", text, flags=re.A)[:200],
    }
    for name, resolver in resolvers.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)


def by_data(key: str, *, _root_: DictConfig) -> Any:
    """Return the value of a key in the most specific row of ``settings``.

    Without a row it is, of an option of the loss, the default of the constructor.
    """
    rows, env, data = _root_.settings, _root_.env.name, _root_.data
    source = f"{data.source}-mixed" if data.random_share else data.source
    row = f"{env}-{source}"
    if source == "d4rl":  # hopper_medium_replay-v2.hdf5, for instance
        row = Path(str(data.path)).stem.partition("-v")[0].replace("_", "-")
    for name in (row, env, "any"):
        if name in rows and key in rows[name]:
            return rows[name][key]
    group, _, option = key.rpartition(".")
    if group != "loss":
        raise ValueError(f"settings have no value of {key} for {row}.")
    return getattr(schema_of(get_class(_root_.loss._target_))(), option)


def _run_dir(resume: str | None, fresh: str) -> str:
    """Return the folder of a run: the one to continue, or a new one."""
    if resume is not None and not Path(resume, "config.yaml").exists():
        raise FileNotFoundError(
            f"resume={resume}: there is no config.yaml in it; give the folder of a run."
        )
    return resume or fresh


def method_name(loss: str, recovery: str | None = "none") -> str:
    """Return the name of a run's method, from the options of its groups."""
    return loss if recovery in (None, "none") else f"{loss}+{recovery}"
