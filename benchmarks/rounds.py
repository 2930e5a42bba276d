"""Processes that each run one update in one precision, a round at a time.

Each has a process of its own because memory is a part of its time: how often large
tensors are given back to the system, and cost page faults when they come again, depends
on everything that a process has allocated before.
"""

from __future__ import annotations

import multiprocessing
import time
from collections import Counter
from itertools import cycle
from multiprocessing.connection import Connection
from typing import Any

import torch
from contenders import Size, make_contender

# A fork shares the imports: a process is there in no time, and small.
FORK = multiprocessing.get_context("fork")


class Timer:
    """Times an update, in the process that is this contender's own.

    Args:
        name: of the contender.
        precision: ``"float32"``, ``"medium"`` (products of float32 matrices may be
            less exact) or ``"bfloat16"`` (autocast, of the losses alone).
        size: of task and networks.
        device: where it runs.
        threads: of torch.
        seconds: how long a round takes, roughly.
    """

    def __init__(
        self,
        name: str,
        precision: str,
        size: Size,
        device: str,
        threads: int,
        seconds: float,
    ) -> None:
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        medium = precision == "medium"
        torch.set_float32_matmul_precision("medium" if medium else "highest")
        self.device = torch.device(device)
        self.update, batches = make_contender(
            name, size, self.device, autocast=precision == "bfloat16"
        )
        self.batches = cycle(batches)
        self.steps = 6
        self.round()  # warm-up, with the capture of a CUDA graph
        self.steps = max(1, round(seconds / self.round()["wall_seconds"]))

    def synchronize(self) -> None:
        """Wait until a GPU has done what it was given."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def round(self) -> dict[str, Any]:
        """Do a round of updates; seconds of one update, and of each of its parts."""
        parts: Counter[str] = Counter()
        self.synchronize()
        wall, cpu = time.perf_counter(), time.process_time()
        before = cpu
        for _ in range(self.steps):
            for part in self.update(next(self.batches)):
                now = time.process_time()
                parts[part] += now - before
                before = now
        self.synchronize()
        return {
            "updates": self.steps,
            "wall_seconds": (time.perf_counter() - wall) / self.steps,
            "cpu_seconds": (time.process_time() - cpu) / self.steps,
            "cpu_seconds_by_part": {
                part: seconds / self.steps for part, seconds in parts.items()
            },
        }


def serve(connection: Connection, *arguments: Any) -> None:
    """Answer each request with a round, or with what went wrong."""
    timer = None
    while connection.recv():
        try:
            timer = timer or Timer(*arguments)
            connection.send(timer.round())
        except Exception as error:
            # One that does not run in this precision must not end all the others.
            connection.send(f"{type(error).__name__}: {error}")


class Contender:
    """One update in one precision, seen from outside its process.

    Args:
        arguments: of :class:`Timer`.

    Attributes:
        rounds: what each round took.
        failure: what went wrong, if something did; it takes part no more then.
    """

    def __init__(self, *arguments: Any) -> None:
        self.rounds: list[dict[str, Any]] = []
        self.failure: str | None = None
        self._connection, theirs = FORK.Pipe()
        self._process = FORK.Process(
            target=serve, args=(theirs, *arguments), daemon=True
        )
        self._process.start()
        theirs.close()

    def round(self) -> None:
        """Do a round of updates."""
        if self.failure is None:
            self._connection.send(True)
            answer = self._connection.recv()
            if isinstance(answer, str):
                self.failure = answer
            else:
                self.rounds.append(answer)

    def close(self) -> None:
        """End the process."""
        self._connection.send(False)
        self._process.join()
