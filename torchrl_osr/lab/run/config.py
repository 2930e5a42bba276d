"""Reading and checking a configuration, also a foreign one.

Networks and loss are built by calling the functions that a configuration names as
``_target_``: this package's, and those of modules that the user trusts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_osr import objectives
from torchrl_osr._checks import check_at_least, check_choice, check_weight
from torchrl_osr._files import write_atomically
from torchrl_osr.lab.run.schema import TrainConfig

CONFIG = "config.yaml"
"""Configuration in the folder of a run."""

FORMAT = 2
"""Format of a run's folder; raised when older runs cannot be read any more."""

TARGET_PACKAGES = (
    "torchrl_osr.modules",
    "torchrl_osr.objectives",
    "torchrl_osr.lab.losses",
)
"""Packages whose public names are allowed as ``_target_``: none of them reads a file or
imports a module. A loss may be named as ``torchrl_osr``'s, too."""

MAY_BE_0 = "data.seed", "dynamics.adversarial_steps", "dynamics.perturbed_start_steps"
SHARES = (
    *("data.random_share", "data.held_out", "dynamics.real_ratio"),
    *("dynamics.known_share", "optim.gamma", "optim.tau", "optim.policy_average"),
)
"""Keys between 0 and 1."""

CHOICES = {
    "logger.kind": ("csv", "tensorboard", "wandb"),
    "optim.actor_schedule": ("constant", "cosine"),
    "trainer.precision": ("float32", "bfloat16"),
}


def checked(config: DictConfig, trust: Sequence[str] = ()) -> TrainConfig:
    """Check a run's configuration, of whatever origin; return it as plain objects.

    A ValueError names a key that is unknown, missing, of the wrong type or out of its
    range, or a target that :func:`check_targets` refuses.
    """
    plain: Any = OmegaConf.to_container(config, resolve=True, enum_to_str=True)
    plain.pop("settings", None)  # interpolations have read them
    if "columns" in plain.get("data", {}):
        plain["data"]["columns"] = read_columns(plain["data"]["columns"])
    check_targets(plain, trust)
    try:
        typed = OmegaConf.merge(OmegaConf.structured(TrainConfig), plain)
    except OmegaConfBaseException as error:
        what = str(error).split("\n")[0]  # then OmegaConf's own types
        raise ValueError(f"{error.full_key}: {what}.") from error
    if missing := sorted(OmegaConf.missing_keys(typed)):
        raise ValueError(f"the configuration lacks {', '.join(missing)}.")
    made = cast(TrainConfig, OmegaConf.to_object(typed))
    # Others would train nonsense, or fail hours later.
    for key, value in flatten(asdict(made)).items():
        groups = "trainer.", "dynamics.", "optim.", "data.num", "data.seed"
        positive = key.startswith(groups)
        if key in CHOICES:
            check_choice(key, value, CHOICES[key])
        elif key == "data.reward_scale" and not value:
            raise ValueError("data.reward_scale must not be 0.")
        elif key in SHARES and not 0 <= value <= 1:
            raise ValueError(f"{key} must be between 0 and 1, got {value}.")
        elif positive and type(value) is int:
            check_at_least(int(key not in MAY_BE_0), key, value)
        elif positive and type(value) is float:
            check_weight(key, value)
    return made


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
    if "${" in str(content):  # resolving it could import or call anything
        raise ValueError(f"{folder / CONFIG} has an interpolation: no run writes one.")
    if (found := content.pop("format", 1)) != FORMAT:
        raise ValueError(
            f"{folder} holds a run of another version of torchrl-osr (format {found}, "
            f"this one reads {FORMAT}): use that version, or train again."
        )
    if isinstance(data := content.get("data"), dict):
        data["download"] = False  # the user decides this at each start
    return content


def write_config(folder: Path, config: TrainConfig) -> None:
    """Write a configuration into the folder of a run."""
    content = {"format": FORMAT} | asdict(config)
    # Of one start alone, and what is already applied.
    for key in ("resume", "force", "trust", "settings"):
        del content[key]
    write_atomically(folder / CONFIG, yaml.safe_dump(content, sort_keys=False))


def read_columns(given: Any) -> Any:
    """Return the names of a log's columns; read them if a YAML file is given."""
    return read_yaml(Path(given).expanduser()) if isinstance(given, str) else given


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping; a ValueError names a damaged file."""
    try:
        content = yaml.safe_load(path.read_bytes())
        if not isinstance(content, dict):
            raise ValueError("it holds no mapping")
    except (yaml.YAMLError, ValueError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path} is damaged: {text}") from error
    return content


def check_targets(config: Mapping[str, Any], trust: Sequence[str] = ()) -> None:
    """Raise a ValueError unless every ``_target_`` is one of our networks or losses.

    Public names of the modules that the user trusts are allowed too.
    """
    allowed = {f"torchrl_osr.{name}" for name in objectives.__all__}
    for name in (*TARGET_PACKAGES, *trust):
        try:
            module = import_module(name)
        except ImportError as error:
            raise ValueError(
                f"trust=[{name}] cannot be imported ({error}): give the name of a "
                "module that is installed or in the current folder."
            ) from error
        names = getattr(module, "__all__", None) or [
            name
            for name, value in vars(module).items()
            if name[0] != "_" and getattr(value, "__module__", None) == module.__name__
        ]
        allowed |= {f"{module.__name__}.{name}" for name in names}
    for target in _targets(config):
        if target not in allowed:
            owner = str(target).rpartition(".")[0]
            raise ValueError(
                f"the configuration names _target_={target}, which is no public name "
                f"of {', '.join([*TARGET_PACKAGES, *trust])}: correct it, or allow it "
                f"with trust=[{owner}] (--trust {owner}) if you know that module."
            )


def check_environment(env_id: str | None, trust: Sequence[str] = ()) -> None:
    """Refuse an id as ``"module:Name-v0"``, which Gymnasium imports, without trust."""
    if (module := (env_id or "").rpartition(":")[0]) not in ("", *trust):
        raise ValueError(
            f"env.id={env_id} imports a module: allow it with trust=[{module}] if you "
            "know it."
        )


def _targets(value: Any) -> Iterator[Any]:
    """Yield every ``_target_``, however deep."""
    if isinstance(value, Mapping):
        if "_target_" in value:
            yield value["_target_"]
        value = list(value.values())
    for each in value if isinstance(value, list) else []:
        yield from _targets(each)


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys; an empty one stays a value."""
    if not isinstance(value, Mapping) or not value:
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}.{key}" if prefix else str(key))
    return flat
