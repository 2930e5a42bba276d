"""Signals that end a run: noted, and acted upon between two updates.

Clusters, containers and preemptible machines send SIGTERM and kill a while later,
Ctrl-C sends SIGINT, a closed terminal SIGHUP. In each case the run finishes the update
that it is in, writes a checkpoint and ends with an exit code of its own.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

EXIT_CODES = {signal.SIGTERM: 75, signal.SIGINT: 130}
"""75 is ``EX_TEMPFAIL`` of ``sysexits.h``, "try again"; 130 is what shells have for
Ctrl-C. SIGHUP, which Windows lacks, is added where it exists."""

if hasattr(signal, "SIGHUP"):
    EXIT_CODES[signal.SIGHUP] = EXIT_CODES[signal.SIGTERM]


class Interrupted(SystemExit):
    """End the process after a signal; the same command continues the run.

    The reason names the signal and, in training, the last checkpoint.
    """

    def __init__(self, reason: str, code: int) -> None:
        super().__init__(reason, code)  # both: a worker process sends it to its parent
        self.reason, self.code = reason, code

    def __str__(self) -> str:
        return self.reason


@contextmanager
def signals_noted() -> Iterator[list[signal.Signals]]:
    """Collect SIGTERM, SIGINT and SIGHUP in a list.

    A second Ctrl-C raises :class:`KeyboardInterrupt` at once.
    """
    came: list[signal.Signals] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(signal.Signals(number))
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            # A print could interrupt another one halfway, which Python refuses.
            message = "\nStopping after this update; Ctrl-C again stops at once.\n"
            os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, message.encode())

    with _handled_by(note):
        yield came


@contextmanager
def signals_raised() -> Iterator[None]:
    """Raise :class:`Interrupted` at once, in work around trainings."""

    def stop(number: int, frame: FrameType | None) -> None:
        name = signal.Signals(number).name
        raise Interrupted(
            f"stopped by {name} before or after training. Resume to continue.",
            EXIT_CODES[signal.Signals(number)],
        )

    with _handled_by(stop):
        yield


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Raise the interrupt that a library has replaced by an error of its own.

    In ``with params.to_module(...)`` tensordict 0.14.3 answers what is no
    :class:`Exception` with a RuntimeError; OmegaConf 2.3 fails to restore its flags.
    """
    try:
        yield
    except Exception as error:
        first: BaseException = error
        while first.__context__ is not None:
            first = first.__context__
            if isinstance(first, (Interrupted, KeyboardInterrupt)):
                raise first from None
        raise


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle the signals in place of Python's defaults and of this module's handlers.

    Other handlers stay, such as submitit's. Python runs them in the main thread alone.
    """
    ours: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        defaults = (signal.SIG_DFL, signal.default_int_handler)
        for number in EXIT_CODES:
            there = signal.getsignal(number)
            if there in defaults or getattr(there, "__module__", None) == __name__:
                ours[number] = there
                signal.signal(number, handler)
    try:
        yield
    finally:
        for number, there in ours.items():
            signal.signal(number, there)
