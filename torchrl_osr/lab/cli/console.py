"""Errors of all commands: one sentence, and with ``--debug`` the traceback."""

from __future__ import annotations

import functools
import logging
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from traceback import walk_tb
from typing import Any

OURS = (ValueError, OSError, RuntimeError, ImportError, ArithmeticError, MemoryError)
"""Errors that this package raises with a whole sentence."""


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
    """Decorate a Hydra task: print its error once, as a sentence.

    The traceback goes into the job's log file. In a sweep, Hydra gets the error and
    runs the other jobs.
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
            folder = HydraConfig.get().runtime.output_dir
            print(f"{folder}: {sentence(error)}", file=sys.stderr)
            raise

    return run


def sentence(error: BaseException) -> str:
    """Return an error in words; of a foreign one also its type and how to see more."""
    if type(error).__module__.startswith(("hydra.", "omegaconf.")):
        return _configuration_error(error)
    if isinstance(error, ModuleNotFoundError):
        return f"{error}. Commands need what 'torchrl-osr[train]' installs."
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"there is no file {error.filename}."
    raised = [frame.f_globals["__name__"] for frame, _ in walk_tb(error.__traceback__)]
    # Unknown where it was raised in another process.
    lost = not raised or type(error.__cause__).__name__ == "_RemoteTraceback"
    ours = lost or raised[-1].startswith("torchrl_osr.")
    if ours and isinstance(error, OURS) and str(error):
        return str(error)
    return f"{type(error).__name__}: {error}\nIts traceback: add --debug."


def guess(name: str, known: Iterable[str]) -> str:
    """Return a question after a mistyped name, if a known one is similar."""
    found = get_close_matches(name, [*known], 1)
    return f" (did you mean {found[0]!r}?)" if found else ""


def _configuration_error(error: Any) -> str:
    """Name the key, and list the choices, of an error of Hydra's or OmegaConf's."""
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError

    cause = error.__cause__ or error
    if "schema@recovery" in str(error):
        return "this loss has a recovery term of its own: leave out recovery=..."
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        options, similar = ", ".join(error.options), guess(name, error.options)
        return f"{group} has no option {name!r}{similar}; it has {options}."
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)):
        known = [*map(str, cause.parent_node or ())]
        similar = guess(str(cause.full_key).rpartition(".")[2], known)
        return (
            f"there is no key {cause.full_key!r}{similar}; "
            f"its group has {', '.join(known)}."
        )
    several = re.match(
        r"(?:Ambiguous value for argument|Sweep parameters) '(.*)'", str(error)
    )
    if several or isinstance(error, OverrideParseException):
        given = several[1] if several else error.override
        key, equals, value = given.partition("=")
        escaped = value.replace('"', '\\"')
        quoted = shlex.quote(f'{key}="{escaped}"')
        if several:
            why = f"has several values: add -m to run each, write a list, [{value}], "
            why += "or quote what is one value"
        elif equals:
            why = "cannot be read: quote a value with blanks, brackets or quotes"
        else:
            return f"{given!r} is no key=value: --help shows the options."
        return f"{given} {why}, as in {quoted}."
    both = (error, error.__cause__)
    lines = [str(each).strip().split("\n")[0] for each in both if each]
    lines[0] = lines[0].rpartition("raised while resolving interpolation: ")[2]
    return ": ".join(lines)
