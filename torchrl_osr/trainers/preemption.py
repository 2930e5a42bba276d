"""SIGTERM: the word of a machine that is about to be taken away.

Clusters, containers and preemptible instances send it, and kill a while later. A run
stops at its next update, writes a checkpoint and ends with an exit code that says: try
again.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EX_TEMPFAIL = 75
"""The exit code of a preempted run; of ``sysexits.h``: temporary failure, try again."""


class Preempted(SystemExit):
    """Ends the process with :data:`EX_TEMPFAIL`: all is saved, to be continued.

    Args:
        reason: what was saved and where.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(EX_TEMPFAIL)
        self.reason = reason

    def __str__(self) -> str:
        return self.reason

    def __reduce__(self) -> tuple[type[Preempted], tuple[str]]:
        # For the way from a worker process to its parent.
        return type(self), (self.reason,)


class Termination:
    """Whether the process was asked to end.

    Attributes:
        asked: by SIGTERM, since :func:`sigterm_noted` was entered.
    """

    asked = False


@contextmanager
def sigterm_noted() -> Iterator[Termination]:
    """Note SIGTERM, in the place of dying of it.

    Only in the main thread, where Python has signals handled, and only where SIGTERM
    would kill: a handler that somebody else has put there stays, such as submitit's,
    which sends jobs back to the queue by another signal.

    Examples:
        >>> import os, signal
        >>> from torchrl_osr.trainers.preemption import sigterm_noted
        >>> with sigterm_noted() as termination:
        ...     os.kill(os.getpid(), signal.SIGTERM)
        ...     termination.asked
        True
    """
    termination = Termination()
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield termination
        return

    def note(number: int, frame: FrameType | None) -> None:
        termination.asked = True

    signal.signal(signal.SIGTERM, note)
    try:
        yield termination
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
