"""TorchRL's loggers by name, CSV files always among them."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl.record.loggers import CSVLogger, Logger, get_logger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_osr._checks import check_choice
from torchrl_osr._files import write_atomically
from torchrl_osr.lab.evaluation import measure_of


def make_loggers(
    kind: str,
    folder: Path,
    *,
    project: str = "torchrl-osr",
    mode: str = "offline",
    **about: Any,
) -> list[Logger]:
    """Loggers of a run: CSV files, which a figure is drawn from, and one of ``kind``.

    Args:
        kind: ``"csv"`` (nothing else), ``"tensorboard"`` or ``"wandb"``.
        folder: of the run; each logger writes below it. A continued run continues its
            W&B run.

    Keyword Args:
        project: W&B project.
        mode: W&B mode: ``"offline"`` (default), ``"online"`` or ``"disabled"``.
        about: what W&B shall know of the run: ``name``, ``group``, ``tags``,
            ``config``.

    Raises:
        ValueError: if ``kind`` is unknown.
        ImportError: if the logger's package is not installed.
    """
    check_choice("logger.kind", kind, ("csv", "tensorboard", "wandb"))
    loggers: list[Logger] = [CSVLogger("csv", log_dir=str(folder))]
    if kind == "csv":
        return loggers
    if find_spec(kind) is None:
        extra = "wandb" if kind == "wandb" else "train"
        raise ImportError(
            f"logger={kind} needs {kind!r}: pip install 'torchrl-osr[{extra}]'"
        )
    # A sweep's jobs may share a process, and one that failed has left its run open.
    options = {"project": project, "mode": mode, "reinit": "finish_previous"} | about
    name = options.pop("name", kind)
    if kind == "wandb":
        known = folder / ".wandb_id"
        if not known.exists():
            write_atomically(known, uuid.uuid4().hex)
        options["id"] = known.read_text()
    else:
        name = kind  # of its folder
    return [*loggers, get_logger(kind, str(folder), name, wandb_kwargs=options)]


def log_outcome(
    loggers: Sequence[Logger],
    rows: Mapping[str, Mapping[str, Any]],
    figures: Mapping[str, Path],
) -> None:
    """Give W&B what a run ends with, and close it; all else is in the curves."""
    for logger in loggers:
        if isinstance(logger, WandbLogger):
            import wandb

            run = logger.experiment
            run.log({name: wandb.Image(str(path)) for name, path in figures.items()})
            for name, row in rows.items():
                measure = measure_of(row)
                run.summary[f"{name}_{measure}"] = row[measure]
            run.finish()
