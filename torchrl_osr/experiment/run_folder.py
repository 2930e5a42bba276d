"""The folder of a run: which configuration it is, how it stands, its small files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_osr._files import write_atomically, write_json
from torchrl_osr.trainers.preemption import Preempted

CONFIG, STATUS = "config.yaml", "status.json"

PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict", "gymnasium", "mujoco")
"""Packages whose versions decide a run's numbers."""

# May differ when a run is continued: they do not touch a single number.
FREE_KEYS = ("resume", "trainer.progress")


def claim(folder: Path, config: DictConfig) -> None:
    """Write the run's configuration into its folder, or check the one that is there.

    Args:
        folder: made if need be.
        config: the composed configuration.

    Raises:
        ValueError: if the folder holds a run of another configuration, naming what
            differs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CONFIG
    if not path.exists():
        write_atomically(path, OmegaConf.to_yaml(config, resolve=True))
        return
    here, there = (flatten(OmegaConf.to_container(each, resolve=True)) for each in (
        config, OmegaConf.load(path)
    ))  # fmt: skip
    differences = [
        f"{key}: {there.get(key)!r} there, {here.get(key)!r} now"
        for key in sorted(here.keys() | there.keys())
        if here.get(key) != there.get(key) and key not in FREE_KEYS
    ]
    if differences:
        raise ValueError(
            f"{folder} holds a run of another configuration: "
            f"{'; '.join(differences)}. Continue that run with resume={folder} and "
            "nothing else, or choose another folder."
        )


def saved_config(folder: Path | str, overrides: Sequence[str]) -> DictConfig:
    """Read the configuration of a run that shall be continued.

    Args:
        folder: of the run.
        overrides: what stood on the command line; only ``resume=`` may.

    Raises:
        FileNotFoundError: if there is no run in ``folder``.
        ValueError: if the command line asks for more than to resume.
    """
    more = [override for override in overrides if not override.startswith("resume=")]
    if more:
        raise ValueError(
            f"resume={folder} continues that run as it is; leave out {' '.join(more)}, "
            "or start a new run without resume=."
        )
    path = Path(folder) / CONFIG
    if not path.exists():
        raise FileNotFoundError(
            f"resume={folder}: there is no {CONFIG} in it; give the folder of a run."
        )
    config = OmegaConf.load(path)
    assert isinstance(config, DictConfig)
    return config


@contextmanager
def status(folder: Path) -> Iterator[None]:
    """Keep ``status.json`` true: running, then done, preempted, or failed and why."""
    write_json(folder / STATUS, {"status": "running", "pid": os.getpid()})
    try:
        yield
    except Preempted as error:
        write_json(folder / STATUS, {"status": "preempted", "reason": error.reason})
        raise
    except BaseException as error:
        reason = f"{type(error).__name__}: {error}"
        with suppress(OSError):  # on a full disk the error itself says more
            write_json(folder / STATUS, {"status": "failed", "error": reason})
        raise
    write_json(folder / STATUS, {"status": "done"})


def package_versions() -> dict[str, str]:
    """Versions of :data:`PACKAGES`, by name with underscores."""
    return {package.replace("-", "_"): version(package) for package in PACKAGES}


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys."""
    if not isinstance(value, Mapping):
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= flatten(item, f"{prefix}.{key}" if prefix else str(key))
    return flat
