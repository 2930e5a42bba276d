"""The folder of a run: its lock, its settings and its status."""

from __future__ import annotations

import functools
import logging
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.conf import HydraConf
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import Container, DictConfig, OmegaConf
from torchrl.checkpoint import CheckpointError

from torchrl_osr._files import read_json, write_atomically, write_json
from torchrl_osr.lab.run.run_config import flatten, read_config
from torchrl_osr.trainers import Interrupted
from torchrl_osr.trainers.interruption import (
    interrupts_kept,
    signals_noted,
    signals_raised,
)

log = logging.getLogger(__name__)

CONFIG, STATUS, LOCK = "config.yaml", "status.json", ".lock"

PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict", "gymnasium", "mujoco")
"""Packages whose versions decide a run's numbers."""

MAY_DIFFER = (
    "data.download",
    "logger.kind",
    "logger.mode",
    "logger.project",
    "trainer.checkpoints_kept",
    "trainer.eval_interval",
    "trainer.log_interval",
    "trainer.num_threads",
    "trainer.progress",
    "trainer.record",
    "trainer.steps",
)
"""Settings with which a run may go on though it began with others: more
``trainer.steps``, and what decides where and how often something is written."""


class Settings:
    """Settings of a run, as a part of its checkpoints.

    Args:
        config: of the run. Its ``force`` lets it go on where the settings were others.
    """

    def __init__(self, config: Any) -> None:
        self.values = flatten(OmegaConf.to_container(config, resolve=True))
        # What is said of one start alone, not of the run.
        for key in ("resume", "trust"):
            self.values.pop(key, None)
        self.force = self.values.pop("force", False)

    def state_dict(self) -> dict[str, Any]:
        """Return the settings."""
        return {"settings": self.values}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Raise a ValueError unless a run of the saved settings may go on with these.

        What differs is named key by key, :data:`MAY_DIFFER` aside.
        """
        there, now = state_dict["settings"], self.values
        before, wanted = (each.get("trainer.steps", 0) for each in (there, now))
        if wanted < before:
            raise ValueError(
                f"it was made with trainer.steps={before}, and {wanted} are fewer: a "
                "run goes on, never back. Give more, or choose another folder."
            )
        refused = "; ".join(
            f"{key}: {there.get(key, 'nothing')!r} there, "
            f"{now.get(key, 'nothing')!r} now"
            for key in sorted(now.keys() | there.keys())
            if now.get(key, ...) != there.get(key, ...) and key not in MAY_DIFFER
        )
        if refused and not self.force:
            raise ValueError(
                f"it was made with other settings ({refused}). Leave these as they "
                "were, choose another folder, or go on all the same with force=true."
            )
        if refused:
            log.warning(
                f"Goes on with other settings, by force=true: {refused}. What the "
                "checkpoint restores stays as it was: networks, learning rates, "
                "discount, weights of the loss's terms, width of the noise."
            )


def resumed(folder: Path, composed: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Configuration of a run that shall be continued.

    Args:
        folder: of the run.
        composed: what Hydra has made of the command line.
        overrides: of the command line. They replace settings of the run;
            :func:`claimed` says which of them may differ.

    Raises:
        FileNotFoundError: if there is no run in ``folder``.
        ValueError: if an override is no setting of the run.
    """
    path = folder / CONFIG
    if not path.exists():
        raise FileNotFoundError(
            f"resume={folder}: there is no {CONFIG} in it; give the folder of a run."
        )
    there = read_config(path)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, absent = override.key_or_group, object()
        value = OmegaConf.select(composed, key, default=absent)
        if absent in (value, OmegaConf.select(there, key, default=absent)):
            raise ValueError(
                f"resume={folder} continues that run, and {override.input_line} is "
                "none of its settings: leave it out."
            )
        if isinstance(value, Container):
            value = OmegaConf.to_container(value, resolve=True)
        OmegaConf.update(there, key, value, merge=False)
    return there


@contextmanager
def claimed(folder: Path, config: DictConfig, job: HydraConf) -> Iterator[None]:
    """Write a run's configuration into its folder, which is to be locked.

    If its checkpoints then turn out not to fit, configuration and status are put back:
    the run is what it was.

    Args:
        folder: of the run.
        config: its configuration, without interpolations when it is read back.
        job: Hydra's own part, with the overrides and the options of the groups; that of
            the beginning stays.

    Raises:
        ValueError: if the folder holds a run of other settings, naming them.
    """
    path, hydra = folder / CONFIG, folder / ".hydra" / "hydra.yaml"
    files = (path, folder / STATUS) if path.exists() else ()
    old = {each: each.read_text() for each in files if each.exists()}
    if path.exists():
        try:
            Settings(config).load_state_dict(Settings(read_config(path)).state_dict())
        except ValueError as error:
            raise ValueError(f"{folder} holds a run, and {error}") from error
    else:
        hydra.parent.mkdir(exist_ok=True)
        write_atomically(hydra, OmegaConf.to_yaml({"hydra": job}))
    # Last: this file makes the folder that of a run.
    saved = OmegaConf.merge(config, {"resume": None, "force": False, "trust": []})
    write_atomically(path, OmegaConf.to_yaml(saved, resolve=True))
    try:
        yield
    except CheckpointError:
        for each, content in old.items():
            write_atomically(each, content)
        raise


@contextmanager
def refusal_noted(folder: Path) -> Iterator[None]:
    """Write why a run does not begin, unless its folder holds one already.

    Of a sweep's jobs, it says which one it was.
    """
    try:
        yield
    except Exception as error:
        if not (folder / CONFIG).exists():
            folder.mkdir(parents=True, exist_ok=True)
            reason = f"{type(error).__name__}: {error}"
            write_json(folder / STATUS, {"status": "failed", "error": reason})
        raise


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Keep other processes out of a run's folder, which is made if need be.

    The lock goes with the process, however it ends.

    Raises:
        ValueError: if another process trains in the folder, naming it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        # Who looks whether the run is at work has the lock for an instant.
        held = FileLock(folder / LOCK).acquire(timeout=1)
    except Timeout as error:
        process = "another process"  # that has just begun
        with suppress(OSError, ValueError):
            process = _process(read_json(folder / STATUS))
        raise ValueError(
            f"{process} is training in {folder}: wait for its end or stop it, or "
            "choose another folder."
        ) from error
    with held:
        yield


def _running() -> dict[str, Any]:
    return {"status": "running", "pid": os.getpid(), "host": platform.node()}


def _process(said: Mapping[str, Any]) -> str:
    return f"process {said.get('pid')} on {said.get('host')}"


def read_status(folder: Path) -> dict[str, Any]:
    """What ``status.json`` says, unless it says ``running`` and the process is gone.

    Returns:
        The file's content. Of a run that is not at work any more the status is
        ``killed``. A process on another machine that does not hold the lock may be
        gone, or the file system has no locks: ``running`` stays, and the ``reason``
        says so.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is damaged.
    """
    said = read_json(folder / STATUS)
    if said.get("status") != "running" or "host" not in said:
        return said
    process, free = _process(said), True
    try:
        if (folder / LOCK).exists():  # not in a copy; looking leaves no file behind
            FileLock(folder / LOCK).acquire(timeout=0).lock.release()
    except Timeout:
        return said | {"reason": f"{process} is at work"}
    except OSError:
        free = False
    if free and said["host"] == platform.node():
        return said | {"status": "killed", "reason": f"{process} is gone"}
    return said | {
        "reason": f"{process}; {platform.node()} cannot see whether it still runs"
    }


def check_ours(folder: Path) -> None:
    """Raise unless a run's folder is there, and this process's.

    Raises:
        FileNotFoundError: if it was removed or renamed since :func:`status` began.
    """
    if not _is_ours(folder):
        raise FileNotFoundError(
            f"{folder} was removed or renamed while the run was going on. Start the "
            "run again in a folder that stays."
        )


def _is_ours(folder: Path) -> bool:
    try:
        return read_json(folder / STATUS) == _running()
    except (OSError, ValueError):
        return False


@contextmanager
def status(folder: Path, trust: Sequence[str] = ()) -> Iterator[None]:
    """Keep ``status.json`` true: running, then done, preempted, or failed and why.

    A run that a signal has stopped is ``preempted``; the command that continues it is
    logged, with the modules that it has to ``trust``. The folder is to be locked, see
    :func:`lock`.
    """
    with signals_raised():
        _say_if_killed(folder)
        write_json(folder / STATUS, _running())
        try:
            with interrupts_kept():
                yield
            check_ours(folder)
            with signals_noted():
                write_json(folder / STATUS, {"status": "done"})
        except Interrupted as error:
            _write_end(folder, {"status": "preempted", "reason": error.reason})
            log.warning(_how_to_continue(folder, trust))
            raise
        except BaseException as error:
            reason = f"{type(error).__name__}: {error}"
            _write_end(folder, {"status": "failed", "error": reason})
            raise


def _say_if_killed(folder: Path) -> None:
    """Warn of a process that has left the folder without a word."""
    with suppress(OSError, ValueError):
        said = read_json(folder / STATUS)
        if said.get("status") == "running":
            log.warning(
                f"This run was begun by {_process(said)} and did not end. The lock is "
                "free: that process is gone, or on another machine to which this file "
                "system does not pass on locks."
            )


def _write_end(folder: Path, end: dict[str, Any]) -> None:
    """Write how a run has ended badly, or warn that this cannot be written."""
    if not _is_ours(folder):
        return
    try:
        with signals_noted():
            write_json(folder / STATUS, end)
    except OSError as error:
        log.warning(f"{error}: the file still says that the run is running.")


def _how_to_continue(folder: Path, trust: Sequence[str]) -> str:
    """Say which command continues a run, quoted for Hydra and for the shell."""
    override = f"resume={folder}"
    if not re.fullmatch(r"[\w./+-]+", str(folder)):
        quoted = str(folder).replace("\\", "\\\\").replace("'", "\\'")
        override = shlex.quote(f"resume='{quoted}'")
    if trust:  # which no run's folder may say
        override += " " + shlex.quote(f"trust=[{','.join(trust)}]")
    return f"Continue with: torchrl-osr train {override}"


def package_versions() -> dict[str, str]:
    """Versions of :data:`PACKAGES`, by name with underscores."""
    return {package.replace("-", "_"): version(package) for package in PACKAGES}


@functools.cache  # of the code that runs: a later commit changes nothing in it
def code_commit() -> str | None:
    """Commit of the checkout that the package is in, if it is in one.

    ``-dirty`` is behind it where files were changed since.
    """
    root = Path(__file__).parents[3]
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
