"""The folder of a run: its lock, its configuration and its status."""

from __future__ import annotations

import logging
import os
import platform
import shlex
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
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

from torchrl_osr._files import read_json, write_atomically, write_json
from torchrl_osr.lab.data import EnvironmentSpec
from torchrl_osr.lab.run.build import set_sizes_from_environment
from torchrl_osr.lab.run.config import (
    CONFIG,
    check_environment,
    checked,
    flatten,
    read_config,
    read_run,
    read_yaml,
    write_config,
)
from torchrl_osr.lab.run.data import set_sizes_from_log
from torchrl_osr.lab.run.load import POLICY
from torchrl_osr.lab.run.schema import TrainConfig, method_name
from torchrl_osr.trainers import Interrupted
from torchrl_osr.trainers.checkpoints import UnfitCheckpointError
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
    *("data.download", "logger.kind", "logger.mode", "logger.project"),
    *("trainer.checkpoints_kept", "trainer.eval_interval", "trainer.log_interval"),
    *("trainer.num_threads", "trainer.progress", "trainer.record", "trainer.steps"),
)
"""Settings that may differ when a run continues: more ``trainer.steps``, and what
decides where and how often something is written."""


class Run(NamedTuple):
    """A run that is open in its folder."""

    config: TrainConfig  # checked, with the sizes of its environment
    folder: Path
    method: str


@contextmanager
def open_run(
    cfg: DictConfig, folder: Path | None = None, job: HydraConf | None = None
) -> Iterator[Run]:
    """Check a configuration, and lock the folder of its run while it is trained.

    The folder gets ``config.yaml``, which a run that fails before its training takes
    away again: it is then no run's. Its ``status.json`` is running, then done,
    preempted or failed. With ``resume`` the run in that folder continues. Folder and
    ``job``, Hydra's part of the configuration, are those of the running job by default.
    """
    job = job or HydraConfig.get()
    folder = folder or Path(cfg.resume or job.runtime.output_dir).absolute()
    trust = list(cfg.trust)  # by the command line, not by a run's folder
    with _lock(folder):
        if cfg.resume is not None:
            cfg = _resumed(folder, cfg, job.overrides.task)
            check_environment(cfg.env.id, trust)
        cfg.data.path = _absolute(cfg.data.path)
        cfg.dynamics.xml = _absolute(cfg.dynamics.xml)
        config = checked(cfg, trust)
        new, finished = not (folder / CONFIG).exists(), None
        if config.env.id is not None:
            set_sizes_from_environment(config.env)
        elif new or config.force:
            set_sizes_from_log(config)
        if new:
            if (folder / POLICY).exists():  # training would replace it
                raise FileExistsError(f"{folder} has a policy of no run: move it away.")
            (folder / HYDRA).parent.mkdir(exist_ok=True)
            write_atomically(folder / HYDRA, OmegaConf.to_yaml({"hydra": job}))
        else:
            stored = read_run(folder, trust)
            if read_status(folder)["status"] == "done":
                finished = stored.trainer.steps
            if config.env.id is None and not config.force:
                for name in EnvironmentSpec._fields:
                    setattr(config.env, name, getattr(stored.env, name))
            config.data.checksum = None if config.force else stored.data.checksum
            config.data.observation_names = stored.data.observation_names
            _check_same(stored, config, folder)
        # Last: config.yaml makes the folder a run's. What differs in a continued run is
        # stored later, when the data's checksum has been compared.
        if new:
            write_config(folder, config)
        choices = read_yaml(folder / HYDRA)["hydra"]["runtime"]["choices"]
        method = method_name(choices["loss"], choices.get("recovery"))
        with _status(folder, finished):
            try:
                yield Run(config, folder, method)
            except UnfitCheckpointError:
                if config.force and not new:
                    write_config(folder, stored)  # which its checkpoint fits
                raise
            except Exception:
                if new and not (folder / "checkpoint").exists():  # nothing was trained
                    (folder / CONFIG).unlink()
                raise


def _absolute(path: Any) -> Any:
    """Return the absolute paths of a file, a list or a pattern."""
    if isinstance(path, ListConfig):
        return [_absolute(each) for each in path]
    if not path:
        return path
    full = str(Path(path).expanduser().absolute())
    return full if Path(full).exists() or glob(full, recursive=True) else path


def _resumed(folder: Path, composed: DictConfig, overrides: Sequence[str]) -> Any:
    """Return a run's configuration with the overrides of the command line."""
    start: dict[str, Any] = {"resume": None, "trust": [], "force": False}
    there = OmegaConf.create(read_config(folder) | start)
    there.data.checksum = None  # compared later, unless forced
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


def _check_same(stored: TrainConfig, config: TrainConfig, folder: Path) -> None:
    """Raise a ValueError that names the settings in which a continued run differs.

    :data:`RESUMABLE` may, and with ``force`` all, except that a run never goes back.
    """
    if config.trainer.steps < stored.trainer.steps:
        raise ValueError(
            f"{folder} holds a run with trainer.steps={stored.trainer.steps}, and "
            f"{config.trainer.steps} are fewer: give more, or choose another folder."
        )
    of_one_start = {"resume", "trust", "force", "settings", "data.checksum", *RESUMABLE}
    if config.optim.actor_schedule == "cosine":  # a longer run decays more slowly
        of_one_start.remove("trainer.steps")
    if config.data.checksum:  # the log may have been moved
        of_one_start.add("data.path")
    there, now = flatten(asdict(stored)), flatten(asdict(config))
    different = "; ".join(
        f"{key}: {there.get(key, 'nothing')!r} there, {now.get(key, 'nothing')!r} now"
        for key in sorted(now.keys() | there.keys())
        if now.get(key, ...) != there.get(key, ...) and key not in of_one_start
    )
    if different and not config.force:
        raise ValueError(
            f"{folder} holds a run with other settings ({different}). Leave these as "
            "they were, choose another folder, or continue with force=true."
        )
    if different:
        log.warning(
            f"Continues with other settings, by force=true: {different}. What the "
            "checkpoint restores stays, such as learning rates."
        )


def _lock(folder: Path) -> AbstractContextManager[Any]:
    """Keep other processes out of a folder; the lock goes with the process."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        # A reader of the status has the lock for an instant.
        return FileLock(folder / LOCK).acquire(timeout=1)
    except Timeout as error:
        raise ValueError(
            f"another process is training in {folder}: wait for its end or stop it, "
            "or choose another folder. If there is none, the file system cannot lock: "
            f"remove {folder / LOCK}."
        ) from error


@contextmanager
def _status(folder: Path, finished: int | None) -> Iterator[None]:
    """Keep ``status.json`` true; log the command that continues a preempted run.

    A run that has ``finished`` so many steps stays done if more are refused.
    """
    running = {"status": "running", "pid": os.getpid(), "host": platform.node()}
    with signals_raised():
        try:
            write_json(folder / STATUS, running)
            with interrupts_kept():
                yield
            with signals_noted():
                write_json(folder / STATUS, {"status": "done"})
        except BaseException as error:
            end = {"status": "failed", "error": f"{type(error).__name__}: {error}"}
            if isinstance(error, Interrupted):
                end = {"status": "preempted", "reason": error.reason}
                resume = shlex.quote(f"resume={folder.as_posix()}")
                log.warning(f"Continue with: torchrl-osr train {resume}")
            elif finished and finished == read_config(folder)["trainer"]["steps"]:
                end = {"status": "done"}
            with signals_noted():
                write_json(folder / STATUS, end)
            raise


def read_status(folder: Path) -> dict[str, Any]:
    """Read ``status.json``; the status of a run whose process is gone is ``killed``.

    A run on another machine stays ``running``: its lock may not be seen from here.
    """
    path = folder / STATUS
    found = read_json(path) if path.exists() else {"status": "unknown"}
    if found.get("status") != "running" or found.get("host") != platform.node():
        return found
    try:
        if (folder / LOCK).exists():  # not in a copy; looking leaves no file behind
            FileLock(folder / LOCK).acquire(timeout=0).lock.release()
    except OSError:  # a Timeout, or another user's lock
        return found
    return found | {"status": "killed", "reason": f"process {found['pid']} is gone"}


def package_versions() -> dict[str, str]:
    """Return versions of :data:`PACKAGES`, by name with underscores."""
    return {package.replace("-", "_"): version(package) for package in PACKAGES}
