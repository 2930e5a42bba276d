"""The console of all commands: an error is one sentence, ``--debug`` its traceback."""

from __future__ import annotations

import functools
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

OURS = (ValueError, OSError, RuntimeError, ImportError, ArithmeticError, MemoryError)
"""What this package raises, with a whole sentence; anything else is a defect."""


EXTRAS = (
    *("filelock", "gymnasium", "hydra", "jinja2", "matplotlib", "mujoco"),
    *("omegaconf", "pandas", "platformdirs", "safetensors", "tqdm"),
)
"""Modules that the commands need, and the package without extras does not."""


@contextmanager
def errors_as_sentences() -> Iterator[None]:
    """End the process with a sentence instead of a traceback, and with code 1.

    ``--debug``, taken off the command line, keeps the traceback, as does Hydra's own
    ``HYDRA_FULL_ERROR=1``. Ctrl-C ends with code 130.
    """
    debug = "--debug" in sys.argv or os.environ.get("HYDRA_FULL_ERROR") == "1"
    sys.argv = [each for each in sys.argv if each != "--debug"]
    # Without it Hydra prints errors itself, in its own words.
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
    """Decorate a Hydra task so that its error is told once, by its sentence alone.

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
            single = HydraConfig.get().mode is RunMode.RUN
            _log(error, files_only=single)
            if single:
                raise SystemExit(sentence(error)) from error
            raise

    return run


def sentence(error: BaseException) -> str:
    """What went wrong, in words; of a defect also its type and how to see more."""
    if type(error).__module__.startswith(("hydra.", "omegaconf.")):
        return _configuration_error(error)
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRAS:
        return f"{error.name!r} is missing: pip install 'torchrl-osr[train]'"
    if "Unable to configure handler" in str(error) and error.__cause__:
        return f"cannot write a log: {sentence(error.__cause__)}"  # Hydra's, of a run
    if isinstance(error, OURS) and str(error):
        return re.sub(r"\[Errno \d+\] ", "", str(error))  # what follows says it
    return f"{type(error).__name__}: {error}\nIts traceback: add --debug."


def _configuration_error(error: Any) -> str:
    """What is wrong with the command line, from an error of Hydra's or OmegaConf's."""
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import (
        ConfigAttributeError,
        ConfigKeyError,
        MissingMandatoryValue,
    )

    cause = error.__cause__
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is missing: give {error.full_key}=..., see --help."
    if isinstance(error, OverrideParseException):
        why = str(error).splitlines()[1]
        return f"cannot read {error.override!r} as key=value: {why}."
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        return f"{group} has no option {name!r}; it has {', '.join(error.options)}."
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)):
        return f"there is no key {cause.full_key!r}; --cfg job prints all that are."
    told = [str(each).strip().split("\n")[0] for each in (error, cause) if each]
    return ": ".join(told)


def _log(error: Exception, *, files_only: bool) -> None:
    """Log an error, its traceback in log files alone."""
    log = logging.getLogger(__name__)
    details = type(error), error, error.__traceback__
    for handler in logging.getLogger().handlers:
        to_file = isinstance(handler, logging.FileHandler)
        if to_file or not files_only:
            handler.handle(
                log.makeRecord(
                    log.name, logging.ERROR, __file__, 0, sentence(error), (),
                    details if to_file else None,
                )
            )  # fmt: skip
