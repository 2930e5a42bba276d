"""Reading the configuration of a run that may come from somebody else.

Networks and loss are built by calling the functions that the configuration names as
``_target_``: this package's, and those of modules that the user trusts.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from torchrl_osr import objectives
from torchrl_osr._files import read_text
from torchrl_osr.lab.run.limits import check_values
from torchrl_osr.lab.run.schema import TargetConfig, TrainConfig, schema_of

# Those of our runs have 4 kB and four levels of nesting. PyYAML needs two seconds for
# 64 kB, and deep nesting exhausts Python's stack.
MAX_CONFIG_BYTES = 2**16
MAX_CONFIG_DEPTH = 32

TARGET_PACKAGES = (
    "torchrl_osr.modules",
    "torchrl_osr.objectives",
    "torchrl_osr.lab.losses",
)
"""Packages whose public names are allowed as ``_target_``: none of them reads a file or
imports a module. A loss may be named as ``torchrl_osr``'s, too."""


def read_run(path: Path, trust: Sequence[str] = ()) -> DictConfig:
    """Read the configuration of a run from which its policy shall be built.

    Raises:
        OSError: if it cannot be read.
        ValueError: naming the file, if :func:`read_config` or :func:`check_run` refuses
            it.
    """
    try:
        return check_run(read_config(path), trust)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def check_run(config: DictConfig, trust: Sequence[str] = ()) -> DictConfig:
    """Check all of a run's configuration, of whatever origin.

    Returns:
        The configuration with the types of its schema.

    Raises:
        ValueError: naming the key, if there is no such key, one is missing or of the
            wrong type, or :func:`check_targets` or
            ``limits.check_values`` refuses it.
    """
    plain = DictConfig(OmegaConf.to_container(config, resolve=True))
    check_targets(plain, trust)
    typed = check_types(_schema(plain), plain)
    # Of what a policy is not built from, a run of an older version may lack some.
    missing = {
        key
        for key in OmegaConf.missing_keys(typed)
        if not key.startswith(("trainer.", "logger."))
    }
    if missing:
        raise ValueError(f"it lacks {', '.join(sorted(missing))}.")
    check_values(flatten(OmegaConf.to_container(typed)))
    return typed


def check_types(schema: DictConfig, config: DictConfig) -> DictConfig:
    """A configuration with the types of a schema.

    Hydra refuses a mistyped ``key=value``, but adds ``+key=value`` even to a typed
    group, where nothing would read it.

    Raises:
        ValueError: naming a key that the schema lacks or whose value is of another
            type.
    """
    try:
        typed = OmegaConf.merge(schema, config)
    except ConfigKeyError as error:
        raise ValueError(
            f"there is no key {error.full_key}: docs/configuration.md has them all."
        ) from error
    except OmegaConfBaseException as error:
        # The further lines are about OmegaConf's own types.
        what = str(error).split("\n")[0]
        raise ValueError(f"{error.full_key or 'a group'}: {what}.") from error
    assert isinstance(typed, DictConfig)
    return typed


def _schema(config: DictConfig) -> DictConfig:
    """What a configuration must look like: a loss of ours has its own options."""
    schema: DictConfig = OmegaConf.structured(TrainConfig)
    for group in (schema.network, schema.inverse_dynamics):
        for key in group:
            if OmegaConf.get_type(group, key) is TargetConfig:
                # The function has keys of its own.
                OmegaConf.set_struct(group[key], False)
    values = flatten(OmegaConf.to_container(config))
    optional = ("recovery", "perturbation.adversary")
    for key in ("loss", "inverse_dynamics.loss", *optional):
        target, value = values.get(f"{key}._target_"), values.get(key)
        if target is None and (value is not None or key not in optional):
            raise ValueError(f"{key} must have options and a _target_, got {value!r}.")
        if str(target).startswith("torchrl_osr."):
            options = OmegaConf.structured(schema_of(get_class(str(target))))
            OmegaConf.update(schema, key, options)
    return schema


def read_config(path: Path) -> DictConfig:
    """Read a run's configuration; nothing is built.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is no mapping, has interpolations, which no run writes and
            which could hide a ``_target_``, or :func:`read_yaml` refuses it.
    """
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path.name} holds no mapping")
    for _, value in _entries(content):
        if isinstance(value, str) and "${" in value:
            raise ValueError(f"{path.name} has the interpolation {value!r}")
    return OmegaConf.create(content)


def read_yaml(path: Path) -> Any:
    """Read a YAML file of a run's folder into plain containers.

    Raises:
        OSError: if it cannot be read.
        ValueError: naming the file, if it is no YAML, has more than 64 KiB or 32 levels
            of nesting, or has tags or aliases, which no run writes and a few of which
            can fill the memory.
    """
    text = read_text(path, max_bytes=MAX_CONFIG_BYTES)
    try:
        _check_yaml(text)
        return OmegaConf.to_container(OmegaConf.create(text))
    except (yaml.YAMLError, OmegaConfBaseException, ValueError) as error:
        raise ValueError(f"{path.name} {' '.join(str(error).split())}") from error


def _check_yaml(text: str) -> None:
    depth = 0
    for event in yaml.parse(text):  # without recursion, and only as far as needed
        if isinstance(event, yaml.AliasEvent) or getattr(event, "tag", None):
            raise ValueError("has YAML tags or aliases, which no run writes")
        if isinstance(event, yaml.ScalarEvent) and not depth:
            raise ValueError("holds a single value")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_CONFIG_DEPTH:
            raise ValueError(f"is nested more than {MAX_CONFIG_DEPTH} deep")


def check_targets(config: DictConfig, trust: Sequence[str] = ()) -> None:
    """Raise unless every ``_target_`` is one of our networks or losses.

    Gymnasium imports the module that an environment's id begins with, as in
    ``"module:Name-v0"``; such an id is refused, too.

    Args:
        config: of the run.
        trust: modules whose public names, those in ``__all__`` or defined in the module
            itself, are allowed too, as is an ``env.id`` that begins with one. They are
            imported, if need be from the current folder.

    Raises:
        ValueError: naming the target or the id, or a trusted module that is not there.
    """
    trusted = {name: _imported(name) for name in trust}
    content = OmegaConf.to_container(config)
    env_id = str(flatten(content).get("env.id", ""))
    for module in module_of(env_id):
        if module not in trusted:
            raise ValueError(
                f"env.id={env_id} imports a module, and a run may come from somebody "
                f"else. If you know {module}, allow it with trust=[{module}]; "
                f"torchrl-osr export takes --trust {module}."
            )
    ours = [import_module(name) for name in TARGET_PACKAGES]
    known = {f"torchrl_osr.{name}" for name in objectives.__all__}
    known = known.union(*map(_public_names, [*ours, *trusted.values()]))
    for key, target in _entries(content):
        if key != "_target_" or str(target) in known:
            continue
        module, _, name = str(target).rpartition(".")
        if module in (*TARGET_PACKAGES, *trusted):
            cure = f"{module} has no public function or class {name!r}"
        elif module:
            cure = f"if you know that module, allow it with trust=[{module}]"
        else:
            cure = "give the names of a module and of a function or class in it"
        raise ValueError(
            f"the configuration has {target!r} called, which is none of "
            f"{', '.join([*TARGET_PACKAGES, *trusted])}: a run may come from somebody "
            f"else, and loading it calls nothing else; {cure}."
        )


def module_of(env_id: str) -> list[str]:
    """The module that Gymnasium imports for an environment, if it does.

    Examples:
        >>> from torchrl_osr.lab.run.run_config import module_of
        >>> module_of("my_robots.arms:Arm-v0"), module_of("Hopper-v5")
        (['my_robots.arms'], [])
    """
    module, colon, _ = env_id.rpartition(":")
    return [module] if colon else []


def chosen_environment(config: DictConfig) -> str | None:
    """The ``env.id`` of a command line, if there is one.

    A package that it names may lie in the current folder.
    """
    if OmegaConf.is_missing(config.env, "id"):
        return None
    env_id = str(config.env.id)
    if module_of(env_id):
        import_from_here()
    return env_id


def import_from_here() -> None:
    """Let modules that the user has named be imported from the current folder.

    It comes last: no file in it takes the place of a package that is installed.
    """
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
    names = getattr(module, "__all__", None)
    if names is None:
        names = [
            name
            for name, value in vars(module).items()
            if name[0] != "_" and getattr(value, "__module__", None) == module.__name__
        ]
    return {f"{module.__name__}.{name}" for name in names}


def _entries(value: Any, key: Any = None) -> Iterator[tuple[Any, Any]]:
    """Yield every key and value, however deep; a list's entries have its key."""
    yield key, value
    if isinstance(value, Mapping):
        for name, each in value.items():
            yield from _entries(each, name)
    elif isinstance(value, list):
        for each in value:
            yield from _entries(each, key)


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys; one that is empty stays a value."""
    if not isinstance(value, Mapping) or not value:
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}.{key}" if prefix else str(key))
    return flat
