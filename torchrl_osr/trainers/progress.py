"""Progress of a training phase: a bar on a terminal, lines in the log elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from torchrl_osr._extras import needed_by

with needed_by("the trainer needs", "train"):
    from tqdm.auto import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 30


class Progress:
    """Show the progress of a phase, as a bar or as lines of the log.

    ``policy: step 2500 of 20000, 210 steps/s, 01:23 left, score 31.2``.

    Args:
        description: name of the phase.
        total: steps of the whole run.
        bar: show a progress bar on a terminal.
        unit: name of a step. Default "step".
    """

    def __init__(
        self, description: str, total: int, bar: bool, unit: str = "step"
    ) -> None:
        self._description, self._total, self._unit = description, total, unit
        self._disable = None if bar else True  # None: without a terminal
        self._result = ""

    @contextmanager
    def shown(self, step: int) -> Iterator[None]:
        """Show the bar, if there is one, from a step on."""
        options = {"unit": self._unit, "disable": self._disable}
        self._bar = tqdm(
            total=self._total, initial=step, desc=self._description, **options
        )
        self._first, self._began = step, time.monotonic()
        self._last_line = self._began
        redirected = nullcontext() if self._bar.disable else logging_redirect_tqdm()
        with self._bar, redirected:
            yield

    def update(self, step: int) -> None:
        """Show a step; where there is no bar, log a line every half minute at most."""
        self._bar.update(step - self._bar.n)
        since = time.monotonic() - self._last_line
        if self._bar.disable and since >= SECONDS_BETWEEN_LINES:
            self._log(step)

    def result(self, step: int, text: str) -> None:
        """Show the result of an evaluation, and log it."""
        self._result = f", {text}"
        self._bar.set_postfix_str(text)
        self._log(step)

    def _log(self, step: int) -> None:
        self._last_line = time.monotonic()
        rate = (step - self._first) / max(self._last_line - self._began, 1e-9)
        pace = ""
        if rate:
            left = tqdm.format_interval((self._total - step) / rate)
            pace = f", {rate:.3g} {self._unit}s/s, {left} left"
        done = f"{self._unit} {step} of {self._total}"
        log.info(f"{self._description}: {done}{pace}{self._result}")
