"""The members of a population: their configurations, their folders, their processes.

A member is an ordinary run in a folder of its own below the population's. On a CPU it
is also a process of its own, since there one update for all is slower than one each.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_osr._files import write_atomically
from torchrl_osr.experiment.run_folder import claim, status
from torchrl_osr.experiment.schema import MAX_FOLDER_NAME
from torchrl_osr.trainers.offline import OfflineTrainer
from torchrl_osr.trainers.processes import train_in_processes
from torchrl_osr.trainers.together import train_together

MAY_DIFFER = (
    "seed",
    "perturbation.std",
    "perturbation.noise",
    "loss.recovery_weight",
    "loss.min_q_weight",
    "loss.diversity_weight",
    "loss.alpha_init",
    "optim.actor_lr",
    "optim.qvalue_lr",
    "optim.inverse_dynamics_lr",
    "optim.gamma",
    "optim.tau",
)
"""Keys that a member may have for itself: numbers that an update computes with. All
others change shapes, the schedule, the data or what is computed."""

# Zero takes the term out of the update, for all members or for none.
WEIGHTS = tuple(key for key in MAY_DIFFER if key.endswith("_weight"))

Run = Generator[OfflineTrainer, None, float]


class Member(NamedTuple):
    """One run of a population.

    Attributes:
        folder: its own, below the population's.
        config: its own, an ordinary run's.
        values: what it has for itself.
    """

    folder: Path
    config: DictConfig
    values: dict[str, Any]


def launch(
    cfg: DictConfig,
    folder: Path,
    script: Path | str,
    overrides: Sequence[str],
    load_data: Callable[[DictConfig], Any],
    run: Callable[[DictConfig, Path, Any], Run],
) -> float:
    """Do a run, or those of a population; return the last score, or the members' mean.

    Args:
        cfg: the composed configuration.
        folder: of the run, or the one that the members' folders shall be in.
        script: does one run with ``resume=<folder>``.
        overrides: what stood on the command line.
        load_data: reads what all members share.
        run: one run, from a configuration, a folder and the data; it yields its
            trainers, for them to be trained.

    Raises:
        ValueError: if the population cannot be trained, before any work.
        RuntimeError: if a member's process failed.
    """
    # The configuration of an older run has no such key.
    alone = cfg.get("population") is None
    members = [] if alone else make_members(cfg, folder)
    claim(folder, cfg)
    with status(folder):
        if alone:
            (score,) = train_together([run(cfg, folder, load_data(cfg))])
            return float(score)
        for member in members:
            claim(member.folder, member.config)
            _note_overrides(member, overrides)
        if _on_cpu(cfg):
            at_once = _cores() // max(cfg.trainer.num_threads, 1)
            train_in_processes(script, [each.folder for each in members], at_once)
            return fmean(_last_score(each.folder) for each in members)
        data = load_data(cfg)
        runs = [
            _with_status(each.folder, run(each.config, each.folder, data))
            for each in members
        ]
        return fmean(train_together(runs))


def make_members(cfg: DictConfig, folder: Path) -> list[Member]:
    """Return the members of a population.

    Args:
        cfg: its ``population`` is a number of seeds, counted from ``seed``, or a list
            of mappings, each with a member's own values by their dotted keys.
        folder: of the population.

    Raises:
        ValueError: if it is something else, or members cannot be trained together,
            naming the member and the key.
    """
    if cfg.trainer.compile and not _on_cpu(cfg):
        raise ValueError(
            "population: trainer.compile=true cannot be had for several members in one "
            "update; leave it out, or take trainer.cudagraph=true."
        )
    members = []
    for index, values in enumerate(_values_of_members(cfg)):
        config = cfg.copy()
        config.population = config.resume = None
        for key, value in values.items():
            _set(config, index, str(key), value)
        # Names that Hydra takes without quotes, as in resume=<folder>.
        words = [f"{key.split('.')[-1]}{value}" for key, value in values.items()]
        name = "-".join([f"member{index}", *words])[:MAX_FOLDER_NAME]
        members.append(Member(folder / name, config, values))
    for key in WEIGHTS:
        weights = [OmegaConf.select(each.config, key) for each in members]
        if any(weights) and not all(weights):
            raise ValueError(
                f"population: {key} is {weights}; it must be 0 for all members or for "
                "none, for it takes the term out of the update."
            )
    return members


def _cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _on_cpu(cfg: DictConfig) -> bool:
    return torch.device(cfg.trainer.device).type == "cpu"


def _values_of_members(cfg: DictConfig) -> list[dict[str, Any]]:
    """Return what each member has for itself."""
    population = cfg.population
    if OmegaConf.is_config(population):
        population = OmegaConf.to_container(population, resolve=True)
    if type(population) is int and population >= 1:
        return [{"seed": cfg.seed + index} for index in range(population)]
    rows = population if isinstance(population, list) else []
    if not rows or not all(isinstance(row, dict) for row in rows):
        raise ValueError(
            "population must be a number of seeds, at least 1, or a list with one "
            "mapping for each member, such as "
            "'population=[{seed:0,loss.recovery_weight:0.1},{seed:1}]'; "
            f"got {population!r}."
        )
    return rows


def _set(config: DictConfig, index: int, key: str, value: Any) -> None:
    """Give a member a value of its own, or say why it cannot have it."""
    nowhere = object()
    if OmegaConf.select(config, key, default=nowhere) is nowhere:
        raise ValueError(f"population: member {index}: there is no key {key!r}.")
    if key not in MAY_DIFFER:
        raise ValueError(
            f"population: member {index}: {key} must be the same for all members, for "
            f"their updates are one. What may differ: {', '.join(MAY_DIFFER)}. For "
            "anything else there is -m."
        )
    try:
        OmegaConf.update(config, key, value)
    except OmegaConfBaseException as error:
        reason = str(error).split("\n")[0]
        raise ValueError(
            f"population: member {index}: {key}={value!r}: {reason}"
        ) from error


def _note_overrides(member: Member, overrides: Sequence[str]) -> None:
    """Write a member's overrides where Hydra would write those of a single run."""
    path = member.folder / ".hydra" / "overrides.yaml"
    if path.exists():
        return
    path.parent.mkdir(exist_ok=True)
    kept = [each for each in overrides if not each.startswith("population=")]
    own = [f"{key}={value}" for key, value in member.values.items()]
    write_atomically(path, OmegaConf.to_yaml(OmegaConf.create(kept + own)))


def _with_status(folder: Path, run: Run) -> Run:
    """Keep a member's ``status.json`` true, as the script does for a single run."""
    with status(folder):
        return (yield from run)


def _last_score(folder: Path) -> float:
    text = (folder / "returns.json").read_text(encoding="utf-8")
    return float(json.loads(text)["last"]["score"])
