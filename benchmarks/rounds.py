"""Processes that each run one implementation in one precision, a round at a time.

An implementation has a process of its own because memory is a part of its time: how
often large tensors are given back to the system, and cost page faults when they come
again, depends on everything that a process has allocated before.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import cycle
from multiprocessing.connection import Connection
from typing import Any

import torch
from contenders import Size, make_contender
from diagnostics import count_operations, profile_update

# A fork shares the imports: a process is there in no time, and small.
FORK = multiprocessing.get_context("fork")


class Timer:
    """Runs an update and says what it took; lives in a process of its own.

    Args:
        precision: ``"float32"``, ``"medium"`` (products of float32 matrices may be
            less exact) or ``"bfloat16"`` (autocast, of the losses alone).
        update: does one update and names its parts.
        batches: what it reads, in turn.
        device: where it runs.
        seconds: how long a round shall take, roughly.
    """

    def __init__(
        self,
        precision: str,
        update: Callable[..., Iterator[str]],
        batches: Sequence[Any],
        device: torch.device,
        seconds: float,
    ) -> None:
        medium = precision == "medium"
        torch.set_float32_matmul_precision("medium" if medium else "highest")
        self.precision, self.device = precision, device
        self.update, self.batches = update, cycle(batches)
        self.steps = 5
        self.round()  # warm-up, with the capture of a CUDA graph
        self.steps = max(1, round(seconds / self.round()["wall_seconds"]))

    def casting(self) -> AbstractContextManager:
        """Return the context in which the losses are computed."""
        if self.precision == "bfloat16":
            return torch.autocast(self.device.type, dtype=torch.bfloat16)
        return nullcontext()

    def once(self) -> Iterator[str]:
        """Do one update."""
        return self.update(next(self.batches), self.casting)

    def synchronize(self) -> None:
        """Wait until a GPU has done what it was given."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def round(self) -> dict[str, Any]:
        """Do a round of updates; return seconds and page faults of one update."""
        parts: Counter[str] = Counter()
        self.synchronize()
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        wall, cpu = time.perf_counter(), time.process_time()
        before = cpu
        for _ in range(self.steps):
            for part in self.once():
                now = time.process_time()
                parts[part] += now - before
                before = now
        self.synchronize()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
        return {
            "updates": self.steps,
            "wall_seconds": wall / self.steps,
            "cpu_seconds": cpu / self.steps,
            "cpu_seconds_by_part": {
                part: seconds / self.steps for part, seconds in parts.items()
            },
            "page_faults": faults / self.steps,
        }

    def diagnose(self) -> dict[str, Any]:
        """Count and profile, apart from the rounds."""
        steps = min(self.steps, 5)
        counts = count_operations(self.once)
        return counts | profile_update(self.once, self.device, steps)


def keep_memory() -> None:
    """Let glibc keep the memory that is freed, for the next time it is asked for."""
    trim_threshold, mmap_max = -1, -4  # of malloc.h
    libc = ctypes.CDLL(None)
    if not libc.mallopt(trim_threshold, 2**31 - 1) or not libc.mallopt(mmap_max, 0):
        raise OSError("This system's malloc cannot be told to keep memory.")


def serve(
    connection: Connection,
    name: str,
    precision: str,
    size: Size,
    device: str,
    threads: int,
    seconds: float,
    keep: bool,
) -> None:
    """Answer each request with what it asks for, or with what went wrong."""
    if keep:
        keep_memory()
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    timer = None
    while (request := connection.recv()) is not None:
        try:
            if timer is None:
                where = torch.device(device)
                update, batches = make_contender(name, size, where)
                timer = Timer(precision, update, batches, where, seconds)
            connection.send(getattr(timer, request)())
        except Exception as error:
            # One that does not run in this precision must not end all the others.
            connection.send(f"{type(error).__name__}: {error}")


class Contender:
    """One implementation in one precision, seen from outside its process.

    Attributes:
        rounds: what each round took.
        diagnosis: what was counted and profiled.
        failure: what went wrong, if something did; it takes part no more then.
    """

    def __init__(self, name: str, precision: str, **settings: Any) -> None:
        self.rounds: list[dict[str, Any]] = []
        self.diagnosis: dict[str, Any] = {}
        self.failure: str | None = None
        self._connection, theirs = FORK.Pipe()
        self._process = FORK.Process(
            target=serve,
            args=(theirs, name, precision),
            kwargs=settings,
            daemon=True,
        )
        self._process.start()
        theirs.close()

    def _ask(self, request: str) -> dict[str, Any]:
        if self.failure is None:
            self._connection.send(request)
            answer = self._connection.recv()
            if not isinstance(answer, str):
                return answer
            self.failure = answer
        return {}

    def round(self) -> None:
        """Do a round of updates."""
        if answer := self._ask("round"):
            self.rounds.append(answer)

    def diagnose(self) -> None:
        """Count and profile an update."""
        self.diagnosis = self._ask("diagnose")

    def close(self) -> None:
        """End the process."""
        self._connection.send(None)
        self._process.join()
