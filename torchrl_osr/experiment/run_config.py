"""Reading the configuration of a run that may come from somebody else.

Networks and loss are built by calling the functions that the configuration names as
``_target_``: only this package's are allowed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from torchrl_osr._files import read_text

# Those of our runs have 4 kB and four levels of nesting. PyYAML needs two seconds for
# 64 kB, and deep nesting exhausts Python's stack.
MAX_CONFIG_BYTES = 2**16
MAX_CONFIG_DEPTH = 32

TARGET_PACKAGES = ("torchrl_osr", "torchrl_osr.modules", "torchrl_osr.objectives")
"""Packages whose public names are allowed as ``_target_``."""


def read_config(path: Path) -> DictConfig:
    """Read a run's configuration; nothing is built.

    Args:
        path: of the YAML file.

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

    Args:
        path: of the file.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it has more than 64 KiB or 32 levels of nesting, or has aliases,
            which no run writes and a few of which can fill the memory.
        YAMLError: if it is no YAML.
    """
    text = read_text(path, max_bytes=MAX_CONFIG_BYTES)
    depth = 0
    for event in yaml.parse(text):  # without recursion, and only as far as needed
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"{path.name} has YAML aliases, which no run writes")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_CONFIG_DEPTH:
            raise ValueError(f"{path.name} is nested more than {MAX_CONFIG_DEPTH} deep")
    return OmegaConf.to_container(OmegaConf.create(text))


def check_targets(config: DictConfig) -> None:
    """Raise unless every ``_target_`` is a public name of this package.

    Gymnasium imports the module that an environment's id begins with, as in
    ``"module:Name-v0"``; such an id is refused, too.

    Args:
        config: of the run.

    Raises:
        ValueError: naming the target or the id.
    """
    env_id = str(OmegaConf.select(config, "env.id", default=""))
    if ":" in env_id:
        raise ValueError(
            f"env.id={env_id} imports a module, and a run may come from somebody else: "
            "import it yourself and leave the module out of the id."
        )
    for key, target in _entries(OmegaConf.to_container(config)):
        if key != "_target_":
            continue
        package, _, name = str(target).rpartition(".")
        known = package in TARGET_PACKAGES and name in import_module(package).__all__
        if not known:
            raise ValueError(
                f"the configuration has {target!r} called, which is none of "
                f"{', '.join(TARGET_PACKAGES)}: a run may come from somebody else, and "
                "loading it calls nothing else."
            )


def _entries(value: Any, key: Any = None) -> Iterator[tuple[Any, Any]]:
    """Yield every key and value, however deep; a list's entries have its key."""
    yield key, value
    if isinstance(value, Mapping):
        for name, each in value.items():
            yield from _entries(each, name)
    elif isinstance(value, list):
        for each in value:
            yield from _entries(each, key)
