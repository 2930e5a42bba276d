"""Errors of all commands: one sentence, and with ``--debug`` the traceback."""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

OURS = (ValueError, OSError, RuntimeError, ImportError, ArithmeticError, MemoryError)
"""Errors that this package raises with a whole sentence; others are defects."""


@contextmanager
def errors_as_sentences() -> Iterator[None]:
    """End the process with a sentence instead of a traceback, and with code 1.

    ``--debug``, taken off the command line, keeps the traceback, as does Hydra's own
    ``HYDRA_FULL_ERROR=1``. Ctrl-C ends with code 130.
    """
    debug = "--debug" in sys.argv or os.environ.get("HYDRA_FULL_ERROR") == "1"
    sys.argv = [each for each in sys.argv if each != "--debug"]
    # Without it Hydra prints errors itself.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(130)
    except SystemExit as end:
        if debug and end.__cause__:
            raise end.__cause__ from None
        raise
    except Exception as error:
        if debug:
            raise
        sys.exit(sentence(error))


def single_job(task: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a Hydra task so that its error is printed once, as a sentence.

    The traceback goes into the job's log file. In a sweep the error goes on to Hydra,
    for the other jobs are to run.
    """

    @functools.wraps(task)
    def run(cfg: Any) -> Any:
        from hydra.core.hydra_config import HydraConfig
        from hydra.types import RunMode

        # Hydra shows what all libraries log, as that fonts have been looked for.
        logging.getLogger("matplotlib").setLevel(logging.WARNING)
        try:
            return task(cfg)
        except Exception as error:
            if not HydraConfig.initialized():  # called as a function
                raise
            details = type(error), error, error.__traceback__
            record = {"levelname": "ERROR", "name": __name__, "exc_info": details}
            for handler in logging.getLogger().handlers:
                if isinstance(handler, logging.FileHandler):
                    handler.handle(logging.makeLogRecord(record))
            if HydraConfig.get().mode is RunMode.RUN:
                raise SystemExit(sentence(error)) from error
            print(sentence(error), file=sys.stderr)
            raise

    return run


def sentence(error: BaseException) -> str:
    """Return an error in words; of a defect also its type and how to see more."""
    if type(error).__module__.startswith(("hydra.", "omegaconf.")):
        return _configuration_error(error)
    if isinstance(error, ModuleNotFoundError):
        return f"{error}. Commands need what 'torchrl-osr[train]' installs."
    if isinstance(error, OURS) and str(error):
        return str(error)
    return f"{type(error).__name__}: {error}\nIts traceback: add --debug."


def _configuration_error(error: Any) -> str:
    """Name the key, and list the choices, of an error of Hydra's or OmegaConf's."""
    from hydra.errors import MissingConfigException
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError

    cause = error.__cause__
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        return f"{group} has no option {name!r}; it has {', '.join(error.options)}."
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)):
        known = ", ".join(map(str, cause.parent_node or ()))
        return f"there is no key {cause.full_key!r}; its group has {known}."
    lines = [str(each).strip().split("\n")[0] for each in (error, cause) if each]
    return ": ".join(lines)
