"""The typed schema of the examples' configuration.

Types and meanings are here, values in ``conf/``. :func:`register` makes the schema
known to Hydra, which then refuses a mistyped key or a value of the wrong type by name.
An option of a loss is declared once, in the loss: its schema is derived from that.
"""

from __future__ import annotations

import functools
import inspect
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import MISSING, OmegaConf

from torchrl_osr import objectives
from torchrl_osr.lab import losses
from torchrl_osr.lab.dynamics import DynamicsOptions
from torchrl_osr.lab.run.published import register_published

# File systems allow 255 bytes, and temporary names beside it need some of them.
MAX_FOLDER_NAME = 200

CHOSEN = {
    name: getattr(package, name)
    for package in (objectives, losses)
    for name in package.__all__
    if name != "ActorCriticLoss"
}
"""Losses that a configuration can name, and the adversary."""


@dataclass
class EnvConfig:
    """Which task.

    Attributes:
        id: Gymnasium id of the environment that is evaluated; package:Name-v0 imports
            the package first.
        name: short name of the task, which behaviour policies and reference scores
            have.
        random_return: mean return of a random policy, score 0; null with
            expert_return: raw returns, unless the task is one of D4RL's.
        expert_return: mean return of an expert, score 100.
        action_low: lowest action in the environment's own units, read from it and kept
            with the run; null if actions are discrete.
        action_high: highest action, likewise.
    """

    id: str = MISSING
    name: str = "${environment_name:${env.id}}"
    random_return: float | None = None
    expert_return: float | None = None
    action_low: list[float] | None = None
    action_high: list[float] | None = None


@dataclass
class ColumnsConfig:
    """Names of a file's columns; null for the usual names, see docs/your_data.md.

    Attributes:
        observation: a name, a pattern such as ``obs_*``, or a list of names.
        action: likewise.
        reward: a name.
        terminated: a name, or false if nothing ever ends the task.
        truncated: a name.
        episode: a name; the numbers or texts in it tell episodes apart.
        step: a name; rows of an episode are sorted by it.
        next_observation: as observation.
    """

    observation: Any = None
    action: Any = None
    reward: str | None = None
    terminated: Any = None
    truncated: str | None = None
    episode: str | None = None
    step: str | None = None
    next_observation: Any = None


@dataclass
class DataConfig:
    """Which data set: rolled out from the packaged behaviour policies, or recorded.

    Attributes:
        source: of the behaviour: random, medium, medium-replay, medium-expert or
            expert; diverse or play in a maze; minari, d4rl or file for recorded data.
        path: recorded data to read, see docs/your_data.md; a list of files is one log.
        columns: what the columns of a file are called.
        action_bounds: lowest and highest action as the recording has them, two numbers
            or two lists; null for those of the environment, or of a Minari set.
        clip_actions: bring recorded actions that are outside of their bounds back to
            them, as many environments do, rather than refuse them.
        missing: error, row or episode: what is left out where values are missing.
        download: fetch the set that path names.
        num_transitions: number of rows.
        seed: random seed of the roll-outs and of the held-out rows.
        random_share: share of the rows that are of random quality instead.
        storage: memory, or disk for sets that do not fit in memory, see
            docs/large_data.md.
        held_out: share of the rows kept from training, to judge the inverse dynamics
            model.
        standardize: bring observations to mean 0 and standard deviation 1.
        reward_scale: factor of the rewards that are trained on.
        reward_shift: added to these rewards; evaluation has the task's own.
    """

    source: str = MISSING
    path: Any = None
    columns: ColumnsConfig = field(default_factory=ColumnsConfig)
    action_bounds: Any = None
    clip_actions: bool = MISSING
    missing: str = MISSING
    download: bool = MISSING
    num_transitions: int = MISSING
    seed: int = MISSING
    random_share: float = MISSING
    storage: str = MISSING
    held_out: float = MISSING
    standardize: bool = MISSING
    reward_scale: float = MISSING
    reward_shift: float = MISSING


@dataclass
class TargetConfig:
    """A function or class to be called, by its full name."""

    _target_: str = MISSING


@dataclass
class NetworkConfig:
    """Actor, critics and inverse dynamics model.

    Attributes:
        actor: the function that builds the policy, of the kind that the loss trains.
        critic: the function that builds the critics, likewise.
        num_cells: width of each hidden layer.
        layer_norm: layer normalisation in the critics; steadier, not in the paper.
    """

    actor: TargetConfig = field(default_factory=TargetConfig)
    critic: TargetConfig = field(default_factory=TargetConfig)
    num_cells: list[int] = MISSING
    layer_norm: bool = MISSING


@dataclass
class PerturbationConfig:
    """The noise of the mixed data set, see ``StatePerturbation``.

    Attributes:
        std: standard deviation of the noise, in units of each observation entry's in
            the data, or of the observation where ``data.standardize`` is false.
        noise: distribution of the noise: gaussian or uniform.
        adversary: options of ``Adversary``, which chooses the perturbed states of the
            policy's training in the place of the noise; null for the noise.
    """

    std: float = MISSING
    noise: str = MISSING
    adversary: Any = None


@dataclass
class InverseDynamicsConfig:
    """Which inverse dynamics model, and how it is trained.

    Attributes:
        network: the function that builds it.
        loss: options of ``InverseDynamicsLoss``.
        shuffle_next: an ablation: train the model with the next state of another
            row.
    """

    network: TargetConfig = field(default_factory=TargetConfig)
    loss: Any = MISSING
    shuffle_next: bool = False


@dataclass
class OptimConfig:
    """Adam's learning rates and what moves with them.

    Attributes:
        actor_lr: learning rate of the policy and the entropy temperature.
        qvalue_lr: learning rate of the critics.
        inverse_dynamics_lr: learning rate of the inverse dynamics model.
        gamma: discount factor.
        n_steps: rewards that the TD target sums before it goes on with the critics'
            value, as many of them as the data have in a row: n-step returns.
        tau: step of the target networks towards the critics, at each update.
        policy_delay: updates of the critics for each of the policy, the entropy
            temperature and the target networks.
        actor_schedule: constant, or cosine: actor_lr falls to 0 along half a cosine
            over trainer.steps.
        qvalue_schedule: the same of qvalue_lr.
        policy_average: share of the new weights in the exponential average of the
            policy's weights, at each update; larger in the first ones, so that the
            average never covers more than about the last tenth of a run. The average is
            what is evaluated and exported; with 1 it is the weights themselves.
    """

    actor_lr: float = MISSING
    qvalue_lr: float = MISSING
    inverse_dynamics_lr: float = MISSING
    gamma: float = MISSING
    n_steps: int = 1
    tau: float = MISSING
    policy_delay: int = 1
    actor_schedule: str = "constant"
    qvalue_schedule: str = "constant"
    policy_average: float = 1.0


@dataclass
class TrainerConfig:
    """How long, how often, where.

    Attributes:
        batch_size: rows of a gradient step.
        inverse_dynamics_steps: gradient steps of the inverse dynamics model.
        steps: gradient steps of the policy and the critics.
        log_interval: steps between log entries.
        eval_interval: steps between evaluations.
        eval_episodes: complete episodes in an evaluation.
        checkpoint_interval: steps between checkpoints.
        checkpoints_kept: number of newest checkpoints that stay, beside the best.
        num_threads: torch threads; 1 where several runs share the machine.
        device: cpu or cuda.
        precision: of the losses' matrix products: float32 or bfloat16.
        matmul_precision: of float32 products, torch's: highest, high or medium.
        record: repeat a recording of the losses' operations: the same bits in less
            time, on a CPU.
        compile: run the losses through ``torch.compile``.
        progress: show progress bars when on a terminal.
    """

    batch_size: int = MISSING
    inverse_dynamics_steps: int = MISSING
    steps: int = MISSING
    log_interval: int = MISSING
    eval_interval: int = MISSING
    eval_episodes: int = MISSING
    checkpoint_interval: int = MISSING
    checkpoints_kept: int = MISSING
    num_threads: int = MISSING
    device: str = MISSING
    precision: str = MISSING
    matmul_precision: str = MISSING
    record: bool = MISSING
    compile: bool = MISSING
    progress: bool = MISSING


@dataclass
class LoggerConfig:
    """Where numbers go besides the CSV files, which are always written.

    Attributes:
        kind: csv for the files alone, tensorboard or wandb.
        project: W&B project.
        mode: W&B mode: offline, online or disabled.
    """

    kind: str = MISSING
    project: str = MISSING
    mode: str = MISSING


@dataclass
class TrainConfig:
    """Everything that ``torchrl-osr train`` reads.

    Attributes:
        seed: random seed of networks, sampling and noise.
        num_random: value of ``loss.num_random`` for the losses with CQL's term.
        min_q_weight: value of ``loss.min_q_weight`` for them.
        recovery: options of ``StateRecoveryLoss``, whose term is added to a loss that
            has none of its own; null for none.
        resume: folder of a run to continue, or to extend with more ``trainer.steps``.
        force: continue although settings differ from those that the run was made with.
        trust: modules of your own, whose losses, networks and environments may be
            named, see docs/extend.md.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    inverse_dynamics: InverseDynamicsConfig = field(
        default_factory=InverseDynamicsConfig
    )
    dynamics: DynamicsOptions = field(default_factory=DynamicsOptions)
    loss: Any = MISSING  # derived from the class that _target_ names
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = MISSING
    num_random: int = MISSING
    min_q_weight: float = MISSING
    recovery: Any = None  # derived like loss
    resume: str | None = None
    force: bool = False
    trust: list[str] = MISSING


@dataclass
class CheckDataConfig:
    """Everything that ``torchrl-osr data`` reads.

    Attributes:
        env: the task that the data are of; none is needed.
        data: which data, as in ``torchrl-osr train``.
        picture: where the picture goes; null for ``<name of the data>-data.png`` in the
            current folder.
        progress: show progress bars when on a terminal.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    data: DataConfig = field(default_factory=DataConfig)
    picture: str | None = None
    progress: bool = MISSING


@dataclass
class CollectConfig:
    """Everything that ``torchrl-osr collect`` reads.

    Attributes:
        env: which environment; of its keys ``id`` alone counts.
        policy: random, a run's folder, or a function of a module.
        path: of the log to write.
        episodes: how many to play.
        noise: on actions, see ``record_episodes``.
        seed: of the first episode.
        progress: a progress bar, when on a terminal.
        trust: modules of your own that a run may name, see docs/extend.md.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    policy: str = MISSING
    path: str = MISSING
    episodes: int = MISSING
    noise: float = MISSING
    seed: int = MISSING
    progress: bool = MISSING
    trust: list[str] = MISSING


def schema_of(target: type) -> type:
    """A structured config with the keyword options of ``target``.

    Args:
        target: a class whose keyword-only parameters, and those of the bases that its
            ``**options`` reach, are the fields; or a dataclass.

    Returns:
        A dataclass whose ``_target_`` is the public name of ``target``.

    Examples:
        >>> from torchrl_osr import OSRLoss
        >>> schema = schema_of(OSRLoss)
        >>> schema().recovery_weight, schema()._target_
        (0.5, 'torchrl_osr.OSRLoss')
    """
    package = "torchrl_osr"
    if target.__module__.startswith(losses.__name__):
        package = losses.__name__
    name = f"{package}.{target.__name__}"
    options: dict[str, tuple[str, Any, Any]] = {"_target_": ("_target_", str, name)}
    for parameter, annotation in _keyword_options(target):
        option = parameter.name, _config_type(annotation), parameter.default
        options.setdefault(parameter.name, option)
    return make_dataclass(f"{target.__name__}Config", options.values())


def _keyword_options(target: type) -> Iterator[tuple[inspect.Parameter, Any]]:
    """Parameters with a default that a configuration can set, and their types."""
    for each in target.__mro__:
        initialize = vars(each).get("__init__")
        if initialize is None:
            continue
        hints = get_type_hints(initialize, vars(inspect.getmodule(each)))
        parameters = inspect.signature(initialize).parameters.values()
        is_dataclass = "__dataclass_fields__" in vars(each)
        for parameter in parameters:
            if parameter.name in ("action_spec", "gamma"):
                continue  # An object of Python, and what every loss refuses.
            if parameter.kind is parameter.KEYWORD_ONLY or (
                is_dataclass and parameter.default is not parameter.empty
            ):
                yield parameter, hints[parameter.name]
        if not any(each.kind is each.VAR_KEYWORD for each in parameters):
            return


def _config_type(annotation: Any) -> Any:
    """The annotation as OmegaConf knows it: a ``Literal`` is the literals' type."""
    if get_origin(annotation) is Literal:
        (kind,) = {type(value) for value in get_args(annotation)}
        return kind
    parts = get_args(annotation)
    if not parts:
        return annotation
    kinds = dict.fromkeys(_config_type(part) for part in parts if part is not NoneType)
    if float in kinds and len(kinds) > 1:
        kinds[int] = None  # in a union OmegaConf does not make a float of an int
    if NoneType in parts:
        kinds[None] = None
    return functools.reduce(operator.or_, kinds)


def _environment_name(env_id: str) -> str:
    from torchrl_osr.lab.data.environment import (
        environment_name,  # needs Gymnasium
    )

    return environment_name(env_id)


def register() -> None:
    """Make schemas and resolvers known to Hydra.

    ``train_schema``, ``check_data_schema``, ``collect_schema``, and in the group
    ``schema`` one for each class of :mod:`torchrl_osr.objectives`; published settings;
    ``environment_name``, the short name of a task; ``run_dir``, by which
    ``resume=folder`` becomes the run's folder; ``method_name``, see
    :func:`method_name`; and ``job_dir``, see :func:`job_folder`.
    """
    store = ConfigStore.instance()
    store.store(name="train_schema", node=TrainConfig)
    store.store(name="check_data_schema", node=CheckDataConfig)
    store.store(name="collect_schema", node=CollectConfig)
    for name, chosen in CHOSEN.items():
        store.store(group="schema", name=name, node=schema_of(chosen))
    register_published()
    resolvers: dict[str, Callable[..., Any]] = {
        "environment_name": _environment_name,
        "run_dir": lambda resume, fresh: resume or fresh,
        "method_name": lambda loss, recovery: method_name(
            {"loss": loss, "recovery": recovery}
        ),
        "job_dir": job_folder,
    }
    for name, resolver in resolvers.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)


def method_name(choices: Mapping[str, str | None]) -> str:
    """What a run's method is called, from its choices of Hydra's groups.

    Examples:
        >>> from torchrl_osr.lab.run.schema import method_name
        >>> method_name({"loss": "rebrac", "recovery": "osr"})
        'rebrac+osr'
    """
    recovery = choices.get("recovery", "none")
    return str(choices["loss"]) + (f"+{recovery}" if recovery != "none" else "")


def job_folder(number: int, overrides: str) -> str:
    """Name of a sweep's job: its number, which is unique, and its overrides.

    Letters, digits and ``._-`` alone: neither a shell nor Hydra needs quotes for it.

    Examples:
        >>> from torchrl_osr.lab.run.schema import job_folder
        >>> job_folder(3, "loss=cql,trainer.steps=200,seed=1")
        '3_loss-cql_steps-200_seed-1'
    """
    last_keys = re.sub(r"[\w.]+\.(\w+=)", r"\1", overrides)
    words = re.sub(r"[^A-Za-z0-9._=,-]+", " ", last_keys)
    pairs = re.sub(r" *([=,]) *", r"\1", words).strip(" .=,-_")
    plain = pairs.translate(str.maketrans("=, ", "-_-"))
    return f"{number}_{plain}"[:MAX_FOLDER_NAME] if plain else str(number)


def named_by_what_differs(arguments: Sequence[str]) -> list[str]:
    """Override that leaves out of :func:`job_folder` what all jobs of a sweep share.

    Returns:
        Nothing where there is no sweep.

    Raises:
        OverrideParseException: an override makes no sense.
    """
    if not {"-m", "--multirun"} & set(arguments):
        return []
    given = [each for each in arguments if "=" in each and not each.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(given)
    shared = [each.key_or_group for each in parsed if not each.is_sweep_override()]
    keys = [key for key in shared if not key.startswith("hydra")]
    return [f"hydra.job.config.override_dirname.exclude_keys=[{','.join(keys)}]"]
