"""The folder of a run: its configuration and its status."""

from __future__ import annotations

import logging
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from torchrl_osr._files import read_json, write_atomically, write_json
from torchrl_osr.experiment.run_config import flatten, read_config
from torchrl_osr.trainers import Interrupted

log = logging.getLogger(__name__)

CONFIG, STATUS, LOCK = "config.yaml", "status.json", ".lock"

PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict", "gymnasium", "mujoco")
"""Packages whose versions decide a run's numbers."""

FREE_KEYS = ("resume", "trainer.progress", "trust")
"""Keys that may differ when a run is continued: no number depends on them."""


def claim(folder: Path, config: DictConfig) -> None:
    """Write the run's configuration into its folder, or compare it with the one there.

    Raises:
        ValueError: if the folder, which is made if need be, holds a run of another
            configuration, naming what differs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CONFIG
    if not path.exists():
        write_atomically(path, OmegaConf.to_yaml(config, resolve=True))
        return
    here = flatten(OmegaConf.to_container(config, resolve=True))
    there = flatten(OmegaConf.to_container(read_config(path)))
    absent = "nothing"
    differences = [
        f"{key}: {there.get(key, absent)!r} there, {here.get(key, absent)!r} now"
        for key in sorted(here.keys() | there.keys())
        if here.get(key, absent) != there.get(key, absent) and key not in FREE_KEYS
    ]
    if differences:
        raise ValueError(
            f"{folder} holds a run of another configuration: "
            f"{'; '.join(differences)}. Continue that run with resume={folder} and "
            "nothing else, or choose another folder."
        )


def saved_config(folder: Path | str, overrides: Sequence[str]) -> DictConfig:
    """Configuration of a run that shall be continued.

    Args:
        folder: of the run.
        overrides: of the command line; only ``resume=`` and ``trust=`` may be among
            them.

    Raises:
        FileNotFoundError: if there is no run in ``folder``.
        ValueError: if the command line asks for more than to resume.
    """
    free = ("resume=", "trust=")
    more = [override for override in overrides if not override.startswith(free)]
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
    return read_config(path)


@contextmanager
def status(folder: Path) -> Iterator[None]:
    """Keep ``status.json`` true: running, then done, preempted, or failed and why.

    A run that a signal has stopped is ``preempted``; the command that continues it is
    logged. One process at a time: the lock goes with the process, however it ends.

    Raises:
        ValueError: if another process trains in the folder, naming it.
    """
    try:
        lock = FileLock(folder / LOCK).acquire(timeout=0)
    except Timeout as error:
        there = read_json(folder / STATUS)
        raise ValueError(
            f"process {there.get('pid')} on {there.get('host')} is training in "
            f"{folder}: wait for its end or stop it, or choose another folder."
        ) from error
    with lock, _status(folder):
        yield


@contextmanager
def _status(folder: Path) -> Iterator[None]:
    running = {"status": "running", "pid": os.getpid(), "host": platform.node()}
    write_json(folder / STATUS, running)
    try:
        yield
    except Interrupted as error:
        write_json(folder / STATUS, {"status": "preempted", "reason": error.reason})
        log.warning(_how_to_continue(folder))
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            log.warning(_how_to_continue(folder))
        reason = f"{type(error).__name__}: {error}"
        with suppress(OSError):  # on a full disk the error itself says more
            write_json(folder / STATUS, {"status": "failed", "error": reason})
        raise
    write_json(folder / STATUS, {"status": "done"})


def _how_to_continue(folder: Path) -> str:
    """Say which command continues a run, quoted for Hydra and for the shell."""
    override = f"resume={folder}"
    if not re.fullmatch(r"[\w./+-]+", str(folder)):
        quoted = str(folder).replace("\\", "\\\\").replace("'", "\\'")
        override = shlex.quote(f"resume='{quoted}'")
    return f"Continue with: torchrl-osr train {override}"


def package_versions() -> dict[str, str]:
    """Versions of :data:`PACKAGES`, by name with underscores."""
    return {package.replace("-", "_"): version(package) for package in PACKAGES}


def code_commit() -> str | None:
    """Commit of the checkout that the package is in, if it is in one.

    ``-dirty`` is behind it where files were changed since.
    """
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    describe = "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *describe],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
