"""TorchRL's loggers by name, with the CSV files always among them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from torchrl.record.loggers import CSVLogger, Logger, get_logger

KINDS = ("csv", "tensorboard", "wandb")


def make_loggers(
    kind: str, folder: Path, *, project: str = "torchrl-osr", mode: str = "offline"
) -> list[Logger]:
    """Return the loggers of a run.

    The CSV files come first and always: a figure needs numbers that can be read back
    without a service, and W&B's offline files cannot be.

    Args:
        kind: ``"csv"``, ``"tensorboard"`` or ``"wandb"``.
        folder: of the run; each logger writes below it.

    Keyword Args:
        project: W&B project.
        mode: W&B mode: ``"offline"`` (default; needs no account), ``"online"`` or
            ``"disabled"``.

    Raises:
        ValueError: if ``kind`` is unknown.
        ImportError: if the logger's package is not installed.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown logger {kind!r}; there are: {', '.join(KINDS)}.")
    loggers: list[Logger] = [CSVLogger("csv", log_dir=str(folder))]
    if kind != "csv":
        if find_spec(kind) is None:
            extra = "wandb" if kind == "wandb" else "examples"
            raise ImportError(
                f"logger={kind} needs {kind!r}: pip install torchrl-osr[{extra}]"
            )
        wandb_kwargs = {"project": project, "mode": mode}
        loggers.append(get_logger(kind, str(folder), kind, wandb_kwargs=wandb_kwargs))
    return loggers
