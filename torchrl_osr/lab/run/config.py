"""Reading and checking a configuration, also one that comes from somebody else.

Networks and loss are built by calling the functions that a configuration names as
``_target_``: this package's, and those of modules that the user trusts.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import yaml
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from torchrl_osr import objectives
from torchrl_osr._files import read_text, write_atomically
from torchrl_osr.lab.run.schema import TrainConfig, schema_of

CONFIG = "config.yaml"
"""Configuration in the folder of a run."""

FORMAT = 2
"""Format of a run's folder; raised when older runs cannot be read any more."""

MAX_BYTES = 2**16
"""Size of a run's YAML file, at most; ours have 4 kB."""

TARGET_PACKAGES = (
    "torchrl_osr.modules",
    "torchrl_osr.objectives",
    "torchrl_osr.lab.losses",
)
"""Packages whose public names are allowed as ``_target_``: none of them reads a file or
imports a module. A loss may be named as ``torchrl_osr``'s, too."""

PARTS = ("loss", "recovery", "inverse_dynamics.loss", "perturbation.adversary")
"""Keys whose options are those of the class that their ``_target_`` names."""

MAY_BE_0 = ("dynamics.adversarial_steps", "dynamics.perturbed_start_steps")
SHARES = (
    *("data.random_share", "data.held_out", "dynamics.real_ratio"),
    *("dynamics.known_share", "optim.gamma", "optim.tau", "optim.policy_average"),
)
"""Keys between 0 and 1."""

CHOICES = {
    "data.storage": ("memory", "disk"),
    "logger.kind": ("csv", "tensorboard", "wandb"),
    "optim.actor_schedule": ("constant", "cosine"),
    "optim.qvalue_schedule": ("constant", "cosine"),
    "trainer.precision": ("float32", "bfloat16"),
}


def checked(config: DictConfig, trust: Sequence[str] = ()) -> TrainConfig:
    """Check all of a run's configuration, of whatever origin.

    Returns:
        The configuration as plain objects.

    Raises:
        ValueError: naming the key, if there is no such key, one is missing, of the
            wrong type or out of its range, or :func:`check_targets` refuses it.
    """
    plain: Any = OmegaConf.to_container(config, resolve=True)
    plain.pop("settings", None)  # interpolations have read them
    check_targets(plain, trust)
    for key in PARTS:
        group, last = _holder(plain, key)
        target = (group.get(last) or {}).get("_target_", "")
        if target.startswith("torchrl_osr."):
            schema = OmegaConf.structured(schema_of(get_class(target)))
            options = check_types(schema, group[last], f"{key}.")
            group[last] = OmegaConf.to_container(options)
    typed = check_types(OmegaConf.structured(TrainConfig), plain)
    if missing := sorted(OmegaConf.missing_keys(typed)):
        raise ValueError(f"the configuration lacks {', '.join(missing)}.")
    made: Any = OmegaConf.to_object(typed)
    check_values(flatten(asdict(made)))
    return cast(TrainConfig, made)


def check_types(schema: DictConfig, values: Any, prefix: str = "") -> DictConfig:
    """Return values with the types of a schema; name what the schema refuses.

    Hydra refuses a mistyped ``key=value``, but adds ``+key=value`` even to a typed
    group, where nothing would read it.
    """
    try:
        typed = OmegaConf.merge(schema, values)
    except ConfigKeyError as error:
        raise ValueError(f"there is no key {prefix}{error.full_key}.") from error
    except OmegaConfBaseException as error:
        what = str(error).split("\n")[0]  # then OmegaConf's own types
        raise ValueError(f"{prefix}{error.full_key}: {what}.") from error
    assert isinstance(typed, DictConfig)
    return typed


def check_values(values: Mapping[str, Any]) -> None:
    """Raise a ValueError for a number that would train nonsense, or fail hours later.

    Args:
        values: by dotted key, see :func:`flatten`.

    Examples:
        >>> from torchrl_osr.lab.run.config import check_values
        >>> check_values({"optim.gamma": 1.5})
        Traceback (most recent call last):
            ...
        ValueError: optim.gamma must be between 0 and 1, got 1.5.
    """
    for key, value in values.items():
        wanted = ""
        if key in CHOICES and value not in CHOICES[key]:
            wanted = f"one of {', '.join(CHOICES[key])}"
        elif key in SHARES and not 0 <= value <= 1:
            wanted = "between 0 and 1"
        elif key in ("seed", "data.seed") and not 0 <= value < 2**32:
            wanted = "between 0 and 2**32 - 1"
        elif isinstance(value, float) and math.isnan(value):
            wanted = "a number"
        elif (
            type(value) is int
            and value < 1
            and key.startswith(("trainer.", "dynamics."))
            and key not in MAY_BE_0
        ):
            wanted = "at least 1"
        if wanted:
            raise ValueError(f"{key} must be {wanted}, got {value}.")


# -- files ---------------------------------------------------------------------------


def read_run(folder: Path, trust: Sequence[str] = ()) -> TrainConfig:
    """Read and check the configuration in the folder of a run."""
    config = OmegaConf.create(read_config(folder))
    try:
        return checked(config, trust)
    except ValueError as error:
        raise ValueError(f"{folder / CONFIG}: {error}") from error


def read_config(folder: Path) -> dict[str, Any]:
    """Read the configuration in the folder of a run; refuse that of another version."""
    content = read_yaml(folder / CONFIG)
    found = content.pop("format", 1)
    if found != FORMAT:
        raise ValueError(
            f"{folder} holds a run of another version of torchrl-osr (format {found}, "
            f"this one reads {FORMAT}): use that version, or train again."
        )
    return content


def write_config(folder: Path, config: TrainConfig) -> None:
    """Write a configuration into the folder of a run."""
    content = {"format": FORMAT} | asdict(config)
    # Of one start alone, and what is already applied.
    for key in ("resume", "force", "trust", "settings"):
        del content[key]
    write_atomically(folder / CONFIG, yaml.safe_dump(content, sort_keys=False))


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a small YAML mapping; a ValueError names a damaged file."""
    try:
        content = yaml.safe_load(read_text(path, max_bytes=MAX_BYTES))
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(
            f"{path} is damaged: {' '.join(str(error).split())}"
        ) from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no mapping.")
    return content


# -- what a configuration may name ---------------------------------------------------


def check_targets(config: Mapping[str, Any], trust: Sequence[str] = ()) -> None:
    """Raise a ValueError unless every ``_target_`` is one of our networks or losses.

    Public names of the modules that the user trusts, those in ``__all__`` or defined in
    the module itself, are allowed too.
    """
    allowed = {f"torchrl_osr.{name}" for name in objectives.__all__}
    for name in (*TARGET_PACKAGES, *trust):
        allowed |= _public_names(_imported(name))
    for target in _targets(config):
        if target in allowed:
            continue
        module, _, name = str(target).rpartition(".")
        cure = f"allow it with trust=[{module}] if you know that module"
        if module in (*TARGET_PACKAGES, *trust):
            cure = f"{module} has no public function or class {name!r}"
        raise ValueError(
            f"the configuration names _target_={target}, which is none of "
            f"{', '.join([*TARGET_PACKAGES, *trust])}: {cure}."
        )


def check_environment(env_id: str, trust: Sequence[str] = ()) -> None:
    """Raise a ValueError if an id imports a module that is not trusted.

    Gymnasium imports the module that an id begins with, as in ``"module:Name-v0"``, and
    a run may come from somebody else.
    """
    if (module := module_of(env_id)) and module not in trust:
        raise ValueError(
            f"env.id={env_id} imports a module: allow it with trust=[{module}] if you "
            "know it."
        )


def module_of(env_id: str) -> str:
    """Return the module that Gymnasium imports for an environment, or nothing.

    The module may lie in the current folder, which comes last: no file in it takes the
    place of an installed package.

    Examples:
        >>> from torchrl_osr.lab.run.config import module_of
        >>> module_of("my_robots.arms:Arm-v0"), module_of("Hopper-v5")
        ('my_robots.arms', '')
    """
    module = env_id.rpartition(":")[0]
    if module:
        import_from_here()
    return module


def import_from_here() -> None:
    """Let modules be imported from the current folder, after all others."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def _imported(name: str) -> ModuleType:
    import_from_here()
    try:
        return import_module(name)
    except (ImportError, TypeError, ValueError) as error:
        raise ValueError(
            f"trust=[{name}] cannot be imported ({error}): give the name of a module "
            f"that is installed, or of a file without its .py in {os.getcwd()}."
        ) from error


def _public_names(module: ModuleType) -> set[str]:
    """Full names of what a module offers, without what it has imported itself."""
    names = getattr(module, "__all__", None) or [
        name
        for name, value in vars(module).items()
        if name[0] != "_" and getattr(value, "__module__", None) == module.__name__
    ]
    return {f"{module.__name__}.{name}" for name in names}


def _targets(value: Any) -> Iterator[Any]:
    """Yield every ``_target_``, however deep."""
    if isinstance(value, Mapping):
        if "_target_" in value:
            yield value["_target_"]
        value = list(value.values())
    for each in value if isinstance(value, list) else []:
        yield from _targets(each)


def _holder(config: dict[str, Any], key: str) -> tuple[dict[str, Any], str]:
    """The group that holds a dotted key, and the key in it."""
    *groups, last = key.split(".")
    for group in groups:
        config = config[group]
    return config, last


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys; an empty one stays a value."""
    if not isinstance(value, Mapping) or not value:
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}.{key}" if prefix else str(key))
    return flat
