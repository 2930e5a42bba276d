"""TorchRL's loggers by name, CSV files always among them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from torchrl.record.loggers import CSVLogger, Logger, get_logger

from torchrl_osr._checks import check_choice


def make_loggers(
    kind: str, folder: Path, *, project: str = "torchrl-osr", mode: str = "offline"
) -> list[Logger]:
    """Loggers of a run: CSV files, which a figure is drawn from, and one of ``kind``.

    Args:
        kind: ``"csv"`` (nothing else), ``"tensorboard"`` or ``"wandb"``.
        folder: of the run; each logger writes below it.

    Keyword Args:
        project: W&B project.
        mode: W&B mode: ``"offline"`` (default), ``"online"`` or ``"disabled"``.

    Raises:
        ValueError: if ``kind`` is unknown.
        ImportError: if the logger's package is not installed.
    """
    check_choice("logger.kind", kind, ("csv", "tensorboard", "wandb"))
    loggers: list[Logger] = [CSVLogger("csv", log_dir=str(folder))]
    if kind == "csv":
        return loggers
    if find_spec(kind) is None:
        extra = "wandb" if kind == "wandb" else "examples"
        raise ImportError(
            f"logger={kind} needs {kind!r}: pip install torchrl-osr[{extra}]"
        )
    options = {"project": project, "mode": mode}
    return [*loggers, get_logger(kind, str(folder), kind, wandb_kwargs=options)]
