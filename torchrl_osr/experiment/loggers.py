"""TorchRL's loggers by name, CSV files always among them."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torchrl.record.loggers import CSVLogger, Logger, get_logger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_osr._checks import check_choice
from torchrl_osr._files import write_atomically
from torchrl_osr.experiment.run_config import flatten


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
    config: DictConfig,
    rows: Mapping[str, Mapping[str, Any]],
    figures: Mapping[str, Path],
) -> None:
    """Log what a run ends with, and close the loggers that need it.

    TensorBoard gets hyperparameters with the scores, W&B the figures and a table.

    Args:
        loggers: of :func:`make_loggers`.
        config: of the run.
        rows: evaluations by name, such as the last and the best.
        figures: PNG files by name.
    """
    for logger in loggers:
        experiment = logger.experiment
        if isinstance(logger, TensorboardLogger):
            settings = flatten(OmegaConf.to_container(config, resolve=True))
            values = {
                key: value if isinstance(value, (bool, int, float)) else str(value)
                for key, value in settings.items()
            }
            scores = {f"score/{name}": row["score"] for name, row in rows.items()}
            # "." is the folder of the curves, not one of its own.
            experiment.add_hparams(values, scores, run_name=".")
            experiment.flush()
        elif isinstance(logger, WandbLogger):
            import wandb

            columns = ["evaluation", "step", "score", "score_low", "score_high"]
            table = wandb.Table(
                columns=columns,
                data=[
                    [name, *(row.get(key) for key in columns[1:])]
                    for name, row in rows.items()
                ],
            )
            pictures = {name: wandb.Image(str(path)) for name, path in figures.items()}
            experiment.log({"scores": table} | pictures)
            experiment.summary.update(
                {f"{name}_score": row["score"] for name, row in rows.items()}
            )
            experiment.finish()
