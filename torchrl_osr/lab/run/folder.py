"""The folder of a run: its lock, its configuration and its status."""

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
from dataclasses import asdict
from glob import glob
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock, Timeout
from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import Container, DictConfig, ListConfig, OmegaConf
from torchrl.checkpoint import CheckpointError

from torchrl_osr._files import read_json, write_atomically, write_json
from torchrl_osr.lab.run.build import read_environment
from torchrl_osr.lab.run.config import (
    CONFIG,
    checked,
    flatten,
    module_of,
    read_config,
    read_run,
    write_config,
)
from torchrl_osr.lab.run.schema import TrainConfig, method_name
from torchrl_osr.trainers import Interrupted
from torchrl_osr.trainers.interruption import (
    interrupts_kept,
    signals_noted,
    signals_raised,
)

log = logging.getLogger(__name__)

STATUS, LOCK, HYDRA = "status.json", ".lock", ".hydra/hydra.yaml"

PACKAGES = ("torchrl-osr", "torch", "torchrl", "tensordict", "gymnasium", "mujoco")
"""Packages whose versions decide a run's numbers."""

RESUMABLE = (
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
"""Settings that may differ when a run continues: more ``trainer.steps``, and what
decides where and how often something is written."""


class Run(NamedTuple):
    """A run that is open in its folder.

    Attributes:
        config: its configuration, checked, with the sizes of its environment.
        folder: where it writes.
        simulated: whether its environment can be played.
        method: name of its method.
    """

    config: TrainConfig
    folder: Path
    simulated: bool
    method: str


@contextmanager
def open_run(
    cfg: DictConfig, folder: Path | None = None, job: HydraConf | None = None
) -> Iterator[Run]:
    """Check a configuration, and hold the folder of its run while it is trained.

    The folder is locked, gets ``config.yaml``, and its ``status.json`` is kept true:
    running, then done, preempted, or failed and why. With ``resume`` the run in that
    folder continues.

    Args:
        cfg: as Hydra has composed it.
        folder: of the run. Default: the folder to resume, or that of Hydra's job.
        job: Hydra's part of the configuration. Default: that of the running job.

    Raises:
        ValueError: if the configuration is refused, another process trains in the
            folder, or it holds a run of other settings.
    """
    job = job or HydraConfig.get()
    if folder is None:
        folder = Path(cfg.resume or job.runtime.output_dir).absolute()
    trust = list(cfg.trust)  # by the command line, not by a run's folder
    overrides = list(job.overrides.task)
    with _lock(folder):
        with _refusal_noted(folder):
            if cfg.resume is None:
                trust += [name] if (name := module_of(cfg.env.id)) else []
                cfg.data.path = _absolute(cfg.data.path)
                cfg.dynamics.path = _absolute(cfg.dynamics.path)
            else:
                cfg = resumed(folder, cfg, overrides)
            config = checked(cfg, trust)
            spec = read_environment(config.env)
        with _claimed(folder, config, trust, job), _status(folder, trust):
            choices = OmegaConf.load(folder / HYDRA).hydra.runtime.choices
            method = method_name(choices.loss, choices.get("recovery"))
            yield Run(config, folder, spec.simulated, method)


def _absolute(path: Any) -> Any:
    """The path of a file, a list or a pattern of them, seen from any folder."""
    if isinstance(path, ListConfig):
        return [_absolute(each) for each in path]
    if path is None:
        return None
    full = str(Path(path).expanduser().absolute())
    return full if Path(full).exists() or glob(full) else path


def resumed(folder: Path, composed: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return the configuration of a run that continues.

    Args:
        folder: of the run.
        composed: what Hydra has made of the command line.
        overrides: of the command line; they replace settings of the run.

    Raises:
        ValueError: if an override is no setting of the run.
    """
    start: dict[str, Any] = {"resume": None, "trust": [], "force": False}
    there = OmegaConf.create(read_config(folder) | start)
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


class Settings:
    """Settings of a run, as a part of its checkpoints.

    Args:
        config: of the run. With its ``force`` it continues where settings differ.
    """

    def __init__(self, config: TrainConfig) -> None:
        self.values = flatten(asdict(config))
        for key in ("resume", "trust", "settings"):  # of one start alone
            self.values.pop(key, None)
        self.force = self.values.pop("force")

    def state_dict(self) -> dict[str, Any]:
        """Return the settings."""
        return {"settings": self.values}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Raise a ValueError that names the settings that differ.

        :data:`RESUMABLE` may, except that a run never goes back.
        """
        there, now = state_dict["settings"], self.values
        if now["trainer.steps"] < there["trainer.steps"]:
            raise ValueError(
                f"it was made with trainer.steps={there['trainer.steps']}, and "
                f"{now['trainer.steps']} are fewer: give more, or choose another "
                "folder."
            )
        different = "; ".join(
            f"{key}: {there.get(key, 'nothing')!r} there, "
            f"{now.get(key, 'nothing')!r} now"
            for key in sorted(now.keys() | there.keys())
            if now.get(key, ...) != there.get(key, ...) and key not in RESUMABLE
        )
        if different and not self.force:
            raise ValueError(
                f"it was made with other settings ({different}). Leave these as they "
                "were, choose another folder, or continue with force=true."
            )
        if different:
            log.warning(
                f"Continues with other settings, by force=true: {different}. What the "
                "checkpoint restores stays: networks, learning rates, discount, "
                "weights of the loss's terms, width of the noise."
            )


@contextmanager
def _claimed(
    folder: Path, config: TrainConfig, trust: Sequence[str], job: HydraConf
) -> Iterator[None]:
    """Write a run's configuration into its folder, unless that holds another run.

    If its checkpoints then turn out not to fit, configuration and status are put back.
    """
    files = [each for each in (folder / CONFIG, folder / STATUS) if each.exists()]
    old = {each: each.read_text() for each in files}
    if (folder / CONFIG).exists():
        there = Settings(read_run(folder, trust))
        try:
            Settings(config).load_state_dict(there.state_dict())
        except ValueError as error:
            raise ValueError(f"{folder} holds a run, and {error}") from error
    else:
        old = {}
        (folder / HYDRA).parent.mkdir(exist_ok=True)
        write_atomically(folder / HYDRA, OmegaConf.to_yaml({"hydra": job}))
    # Last: this file makes the folder that of a run.
    write_config(folder, config)
    try:
        yield
    except CheckpointError:
        for each, content in old.items():
            write_atomically(each, content)
        raise


@contextmanager
def _refusal_noted(folder: Path) -> Iterator[None]:
    """Write why a run does not begin, unless its folder holds one already."""
    try:
        yield
    except Exception as error:
        if not (folder / CONFIG).exists():
            reason = f"{type(error).__name__}: {error}"
            write_json(folder / STATUS, {"status": "failed", "error": reason})
        raise


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder; the lock goes with the process."""
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


# -- status --------------------------------------------------------------------------


@contextmanager
def _status(folder: Path, trust: Sequence[str]) -> Iterator[None]:
    """Keep ``status.json`` true; log the command that continues a preempted run."""
    with signals_raised():
        write_json(folder / STATUS, _running())
        try:
            with interrupts_kept():
                yield
            check_ours(folder)
            with signals_noted():
                write_json(folder / STATUS, {"status": "done"})
        except Interrupted as error:
            _write_end(folder, {"status": "preempted", "reason": error.reason})
            plain = re.fullmatch(r"[\w./-]+", str(folder))
            place = folder if plain else f"'{folder}'"  # quoted for Hydra
            command = f"torchrl-osr train {shlex.quote(f'resume={place}')}"
            if trust:  # which no run's folder may say
                command += " " + shlex.quote(f"trust=[{','.join(trust)}]")
            log.warning(f"Continue with: {command}")
            raise
        except BaseException as error:
            reason = f"{type(error).__name__}: {error}"
            _write_end(folder, {"status": "failed", "error": reason})
            raise


def read_status(folder: Path) -> dict[str, Any]:
    """Read ``status.json``; the status of a run whose process is gone is ``killed``.

    A run on another machine stays ``running``: its lock may not be seen from here.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is damaged.
    """
    found = read_json(folder / STATUS)
    if found.get("status") != "running" or found.get("host") != platform.node():
        return found
    try:
        if (folder / LOCK).exists():  # not in a copy; looking leaves no file behind
            FileLock(folder / LOCK).acquire(timeout=0).lock.release()
    except Timeout:
        return found
    return found | {"status": "killed", "reason": f"{_process(found)} is gone"}


def check_ours(folder: Path) -> None:
    """Raise a FileNotFoundError if a run's folder is not this process's any more."""
    if not _is_ours(folder):
        raise FileNotFoundError(f"{folder} was removed or renamed during the run.")


def _is_ours(folder: Path) -> bool:
    with suppress(OSError, ValueError):
        return read_json(folder / STATUS) == _running()
    return False


def _running() -> dict[str, Any]:
    return {"status": "running", "pid": os.getpid(), "host": platform.node()}


def _process(found: Mapping[str, Any]) -> str:
    return f"process {found.get('pid')} on {found.get('host')}"


def _write_end(folder: Path, end: dict[str, Any]) -> None:
    """Write how a run has ended badly, or warn that this cannot be written."""
    try:
        if _is_ours(folder):
            with signals_noted():
                write_json(folder / STATUS, end)
    except OSError as error:
        log.warning(f"{error}: the file still says that the run is running.")


# -- versions ------------------------------------------------------------------------


def package_versions() -> dict[str, str]:
    """Return versions of :data:`PACKAGES`, by name with underscores."""
    return {package.replace("-", "_"): version(package) for package in PACKAGES}


@functools.cache  # of the code that runs: a later commit changes nothing in it
def code_versions() -> dict[str, str]:
    """Return :func:`package_versions`, and ``git describe --dirty`` of a checkout."""
    root, commit = Path(__file__).parents[3], {}
    describe = "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"
    if (root / ".git").exists():
        with suppress(OSError, subprocess.SubprocessError):
            command = ["git", "-C", str(root), *describe]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            commit = {"commit": done.stdout.strip()}
    return package_versions() | commit
