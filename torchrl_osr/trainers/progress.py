"""Progress of a long task: a bar on a terminal, lines in the log elsewhere."""

from __future__ import annotations

import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from typing import Any

from torchrl_osr._checks import needed_by

with needed_by("the trainer needs", "train"):
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 30
LINE = "{desc}: {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"


class _Lines(tqdm):
    """Log a line whenever a bar would be drawn."""

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        if msg is None:
            log.info(str(self))
        return True


@contextmanager
def progress_bar(
    what: str, total: int, *, first: int = 0, unit: str = "step", bar: bool = True
) -> Iterator[Any]:
    """Open tqdm's bar at a step; off a terminal or in a child process, log at times."""
    options: Any = {"desc": what, "total": total, "unit": unit, "initial": first}
    # Bars of several processes would write over each other.
    if bar and sys.stderr.isatty() and parent_process() is None:
        with logging_redirect_tqdm(), tqdm(**options) as shown:
            yield shown
    else:
        options |= {"file": io.StringIO(), "bar_format": LINE, "leave": False}
        options |= {"mininterval": SECONDS_BETWEEN_LINES, "miniters": 1}
        with _Lines(**options) as shown:
            yield shown
