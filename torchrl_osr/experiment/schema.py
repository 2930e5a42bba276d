"""The typed schema of the examples' configuration.

Types and meanings are here, values in ``conf/``. :func:`register` makes the schema
known to Hydra, which then refuses a mistyped key or a value of the wrong type by name.
An option of a loss is declared once, in the loss: its schema is derived from that.
"""

from __future__ import annotations

import functools
import inspect
import operator
from collections.abc import Iterator
from dataclasses import dataclass, field, make_dataclass
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from torchrl_osr import objectives

# File systems allow 255 bytes, and temporary names beside it need some of them.
MAX_FOLDER_NAME = 200


@dataclass
class EnvConfig:
    """Which task.

    Attributes:
        name: short name of the task, which behaviour policies and reference scores
            have.
        id: Gymnasium id of the environment that is evaluated.
    """

    name: str = MISSING
    id: str = MISSING


@dataclass
class DataConfig:
    """Which data set: rolled out from the packaged behaviour policies, or recorded.

    Attributes:
        quality: of the behaviour: random, medium, medium-replay, medium-expert or
            expert; diverse or play in a maze; minari, d4rl or file for recorded data.
        path: recorded data to read, see docs/your_data.md.
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

    quality: str = MISSING
    path: str | None = None
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
        num_cells: width of each hidden layer.
        layer_norm: layer normalisation in the critics; steadier, not in the paper.
    """

    actor: TargetConfig = field(default_factory=TargetConfig)
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
        tau: step of the target networks towards the critics, at each update.
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
        inverse_dynamics_steps: gradient steps of the inverse dynamics model.
        steps: gradient steps of the policy and the critics.
        log_interval: steps between log entries.
        eval_interval: steps between evaluations.
        eval_episodes: complete episodes in an evaluation.
        checkpoint_interval: steps between checkpoints.
        checkpoints_kept: number of newest checkpoints that stay, beside the best.
        nonfinite: at a loss or gradient that is not finite, stop or skip the update.
        num_threads: torch threads; 1 where several runs share the machine.
        device: cpu or cuda.
        precision: of the losses' matrix products: float32 or bfloat16.
        matmul_precision: of float32 products, torch's: highest, high or medium.
        record: repeat a recording of the losses' operations: the same bits in less
            time, on a CPU.
        compile: run the losses through ``torch.compile``.
        cudagraph: run updates as a CUDA graph; needs ``device=cuda``.
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
    nonfinite: str = MISSING
    num_threads: int = MISSING
    device: str = MISSING
    precision: str = MISSING
    matmul_precision: str = MISSING
    record: bool = MISSING
    compile: bool = MISSING
    cudagraph: bool = MISSING
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
        resume: folder of a run to continue, or to extend with more ``trainer.steps``.
        force: continue although settings differ from those that the run was made with.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    inverse_dynamics: InverseDynamicsConfig = field(
        default_factory=InverseDynamicsConfig
    )
    loss: Any = MISSING  # derived from the class that _target_ names
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = MISSING
    num_random: int = MISSING
    resume: str | None = None
    force: bool = False


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
    name = f"torchrl_osr.{target.__name__}"
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


def register() -> None:
    """Make schemas and resolvers known to Hydra.

    ``train_schema``, and in the group ``schema`` one for each class of
    :mod:`torchrl_osr.objectives`; ``run_dir``, by which ``resume=folder`` becomes the
    run's folder, and ``job_dir``, which names a sweep's folders.
    """
    store = ConfigStore.instance()
    store.store(name="train_schema", node=TrainConfig)
    for name in set(objectives.__all__) - {"BaseLoss"}:
        schema = schema_of(getattr(objectives, name))
        store.store(group="schema", name=name, node=schema)
    OmegaConf.register_new_resolver(
        "run_dir", lambda resume, fresh: resume or fresh, replace=True
    )
    OmegaConf.register_new_resolver(
        "job_dir",
        lambda number, overrides: f"{number}_{overrides}"[:MAX_FOLDER_NAME],
        replace=True,
    )
